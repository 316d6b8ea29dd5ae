// A newcomer's way: open the page, press the camera's button, see the face move; open the link in a second browser, see the same
// face; start another tracker, see it take over by the rule.
//
// Environment, besides lib.mjs: RHYTID_CLIP, a film of a face; RHYTID_SERVER the server's program; RHYTID_UDP the port that takes
// OpenSeeFace's datagrams for the room "demo"; RHYTID_FEED a feed of landmarks; RHYTID_SHOTS a folder for pictures of it, which are
// left out without, and of a phone's page.
import { spawn } from "node:child_process";
import path from "node:path";
import { check, difference, faceIsThere, launch, live, open, picture, run, text, until } from "./lib.mjs";

const shots = process.env.RHYTID_SHOTS;

async function shoot(page, name) {
  if (shots) await page.screenshot({ path: path.join(shots, name), type: "jpeg", quality: 82, timeout: 180_000 });
}

async function moves(page) {
  const first = await picture(page);
  await until("a moving picture", async () => difference(first, await picture(page)) > 0.5);
}

await run(async () => {
  const faked = ["--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream", `--use-file-for-fake-video-capture=${process.env.RHYTID_CLIP}`];
  const first = await launch(...faked);
  const size = shots ? { width: 1280, height: 800 } : { width: 780, height: 520 };
  const { page, errors } = await open(first, "/", { size });
  await faceIsThere(page);
  check("the page without a room's name shows demo", (await text(page, "#room-name")) === "demo");
  if (!(await page.isVisible("#panel"))) await page.click("#panel-button");
  await page.click("#tab-camera");
  const camera = page.frameLocator("#camera-frame iframe");
  await camera.locator("#start").click();
  await camera.locator("#publish-text", { hasText: "Publishing to room demo." }).waitFor({ timeout: 120_000 });
  await live(page);
  check("one button and the face is live", true);
  await camera.locator("#seen-text", { hasText: "Face seen" }).waitFor();
  if (shots) await page.waitForTimeout(6000);
  await shoot(page, "browser.jpg");

  const listing = async () => {
    const { rooms } = await (await page.request.get(new URL("/api/rooms", page.url()).href)).json();
    return rooms.find(({ name }) => name === "demo");
  };
  await page.click("#tab-share");
  const frame = async () => (await listing()).frame;
  const hidden = await frame();
  await until("frames of a camera whose tab is not shown", async () => {
    const { session, seq } = await frame();
    return session === hidden.session && seq > hidden.seq + 5;
  });
  check("the camera goes on while another tab is shown", true);
  const address = await page.locator("#share-view").inputValue();
  const second = await launch();
  const other = await open(second, `${address}&bare=1`, { size: { width: 320, height: 320 } });
  await faceIsThere(other.page);
  await live(other.page);
  await moves(other.page);
  check("the link in a second browser shows the same room's face, moving", (await listing()).viewers === 2);

  await page.click("#tab-sources");
  const drives = async () => (await page.locator(".source:has(li.drives) h3").allTextContents()).join();
  // Where the machine draws so slowly that its frames are half a second apart, it leads without counting as live.
  await until("the webcam", async () => (await page.locator(".source").count()) === 1);
  check("Sources names the webcam", (await page.locator(".source h3").textContent()) === "webcam");
  const fake = spawn(process.env.RHYTID_SERVER, ["fake", process.env.RHYTID_FEED, "--as", "openseeface", "--to", process.env.RHYTID_UDP, "--loop"], { stdio: "ignore" });
  process.on("exit", () => fake.kill("SIGKILL"));
  await until("OpenSeeFace driving", async () => (await drives()).startsWith("openseeface"));
  check("another tracker takes over: of equal priority the later one drives", (await page.locator(".source").count()) === 2);
  await moves(other.page);
  check("the second browser's face goes on moving", true);
  check("the second browser's console says nothing of errors", other.errors.length === 0, other.errors.join("; "));
  await second.close();
  await page.locator('.source[data-slot="openseeface"] summary').click();
  await until("the delay beside a knob", async () => / ms$/.test(await text(page, "#source-openseeface-knob-smoothing-mouth + output")));
  await page.mouse.move(0, 0);
  await page.locator("#page-sources").evaluate((place) => place.scrollTo(0, 0));
  await shoot(page, "sources.jpg");
  if (shots) {
    await page.setViewportSize({ width: 390, height: 844 });
    await shoot(page, "phone-sources.jpg");
    await page.locator('.source[data-slot="openseeface"] [data-do="fit"]').click();
    await shoot(page, "phone-wizard.jpg");
    await page.click("#wizard-buttons >> text=Start");
    await page.waitForTimeout(1500);
    await shoot(page, "phone-wizard-step.jpg");
    await page.click("#wizard-buttons >> text=Cancel");
    await page.setViewportSize(size);
  }
  fake.kill("SIGTERM");
  // Where the machine draws so slowly that the webcam's frames are half a second apart, it leads without counting as live.
  await until("the end of OpenSeeFace", async () => !(await drives()).includes("openseeface"));
  const after = await frame();
  await until("frames of the webcam", async () => (await frame()).seq > after.seq + 3);
  // The silent tracker keeps its slot, at its priority, until the server has waited for it long enough.
  await until("the webcam as the publisher", async () => (await listing()).publisher.source === "webcam");
  check("where it falls silent, the face goes on by the webcam", true);
  check("the console says nothing of errors", errors.length === 0, errors.join("; "));
  await first.close();
});
