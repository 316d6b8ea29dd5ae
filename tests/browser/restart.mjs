// A server that goes away and comes back: the page says so, and is live again by itself, viewer and puppeteer alike.
//
// Environment, besides lib.mjs: RHYTID_SERVER the server's program, RHYTID_PORT a free port.
import { spawn } from "node:child_process";
import { check, faceIsThere, launch, live, open, roomName, run, text, until } from "./lib.mjs";

const port = process.env.RHYTID_PORT ?? "7879";
const address = process.env.RHYTID_PAGE ?? `http://127.0.0.1:${port}`;

function serve() {
  const server = spawn(process.env.RHYTID_SERVER ?? "rhytid-server", ["serve", "--listen", `127.0.0.1:${port}`], { stdio: ["ignore", "pipe", "ignore"] });
  process.on("exit", () => server.kill("SIGKILL"));
  return new Promise((resolve, reject) => {
    server.on("error", reject);
    server.stdout.once("data", () => resolve(server));
    server.on("exit", () => reject(new Error("the server ended at once")));
  });
}

await run(async () => {
  let server = await serve();
  const browser = await launch();
  const { page } = await open(browser, `${address}/?room=${roomName("restart")}`, { size: { width: 1200, height: 600 } });
  await faceIsThere(page);
  if (!(await page.isVisible("#panel"))) await page.keyboard.press("h");
  await page.click("#tab-puppet");
  await page.locator("#slider-shape-jawOpen, #slider-shape-browInnerUp").first().fill("0.5");
  await live(page);
  check("the page is live", true);
  const gone = new Promise((resolve) => server.on("exit", resolve));
  server.kill("SIGTERM");
  await gone;
  await until("the word Reconnecting", async () => (await text(page, "#state-text")) === "Reconnecting");
  check("a server that is gone is said to be gone", await page.isVisible("#notice"));
  await page.waitForTimeout(2000);
  server = await serve();
  await live(page);
  check("the page is live again by itself", true);
  check("the slider still stands where it was", (await page.locator("#slider-shape-browInnerUp").inputValue()) === "0.5");
  await browser.close();
  server.kill("SIGTERM");
});
