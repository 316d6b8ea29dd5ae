// A server that demands tokens: the page asks for one, or takes it from behind the address's `#`, and never shows or passes it on.
//
// Environment, besides lib.mjs: RHYTID_VIEW and RHYTID_PUBLISH, tokens for the room demo.
import { check, faceIsThere, launch, live, open, run, text, until } from "./lib.mjs";

const { RHYTID_VIEW: view, RHYTID_PUBLISH: publish } = process.env;
const SIZE = { width: 1200, height: 700 };

await run(async () => {
  const browser = await launch();
  const context = await browser.newContext();
  const requests = [];
  context.on("request", (request) => requests.push(request.url()));

  // Without a token.
  const { page } = await open(browser, "/?room=demo", { size: SIZE, context });
  await until("a question for a token", () => page.isVisible("#access"));
  check("a page without a token asks for one", (await text(page, "#access-why")).startsWith("This server lets in who has a token."));
  check("and says that it is refused", (await text(page, "#state-text")) === "Refused");
  await page.fill("#access-input", "not a token");
  await page.click("#access form button");
  check("what cannot be a token is refused in words", (await text(page, "#access-why")).startsWith("That is no token"));
  await page.fill("#access-input", `${publish.slice(0, -6)}AAAAAA`);
  await page.click("#access form button");
  await until("the server's no", async () => (await page.isVisible("#access")) && (await text(page, "#access-why")).includes("none of this server"));
  check("a forged token is refused by the server", true);
  await page.fill("#access-input", publish);
  await page.click("#access form button");
  await until("the room", async () => (await text(page, "#state-text")) === "Waiting for a face");
  check("a token opens the room", !(await page.isVisible("#access")));
  await faceIsThere(page);
  if (!(await page.isVisible("#panel"))) await page.keyboard.press("h");
  await page.click("#tab-puppet");
  await page.locator("#slider-shape-browInnerUp").fill("0.5");
  await live(page);
  check("and lets its bearer move the face", true);

  // Links carry a token only where one is given for that.
  await page.click("#tab-share");
  await until("links", async () => (await page.inputValue("#share-view")).includes("room=demo"));
  const links = async () => Promise.all(["view", "obs", "track", "publish"].map((name) => page.inputValue(`#share-${name}`)));
  check("links carry no token by themselves", (await links()).every((link) => !link.includes("token")));
  await page.fill("#share-token", view);
  let shared = await links();
  check("a token to watch goes into links to watch", shared[0].endsWith(`#token=${view}`) && shared[1].endsWith(`#token=${view}`));
  check("and into no other", !shared[2].includes("token") && !shared[3].includes("token"));
  await page.fill("#share-token", publish);
  shared = await links();
  check("a token to publish goes into the camera's link alone", shared[2].endsWith(`#token=${publish}`) && !shared[0].includes("token") && !shared[1].includes("token"));
  await page.click("#room-button");
  await until("the word about the list", async () => (await text(page, "#room-list")).includes("Only who may do everything"));
  check("the list of rooms is said to be for others", true);

  // Behind the address, in another tab.
  const other = await browser.newContext();
  other.on("request", (request) => requests.push(request.url()));
  const second = await open(browser, `/?room=demo#token=${view}`, { size: SIZE, context: other });
  await live(second.page);
  check("a link with a token opens the room", true);
  check("the address is cleared of it", !second.page.url().includes("token"));
  if (!(await second.page.isVisible("#panel"))) await second.page.keyboard.press("h");
  await second.page.click("#tab-puppet");
  await second.page.locator("#slider-shape-browInnerUp").fill("0.8");
  await until("a question for another token", () => second.page.isVisible("#access"));
  check("a token to watch does not publish", (await text(second.page, "#access-why")).startsWith("The token is for watching"));
  check("and the face stays in view", (await text(second.page, "#state-text")) === "Live");
  await second.page.reload();
  await live(second.page);
  check("the tab keeps it", true);

  check("no token has been asked for by an address", requests.length > 10 && !requests.some((url) => url.includes(view) || url.includes(publish)));
  await browser.close();
});
