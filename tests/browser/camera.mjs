// The camera page: a talking head before a faked camera drives another browser page's picture. Without a camera, or where it is
// not allowed, the page says so.
//
// Environment, besides lib.mjs: RHYTID_CLIP, a film of a face (.mjpeg or .y4m).
import { PATIENCE, check, difference, faceIsThere, launch, live, open, picture, roomName, run, text, until } from "./lib.mjs";

await run(async () => {
  const room = roomName("camera");
  const faked = ["--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream", `--use-file-for-fake-video-capture=${process.env.RHYTID_CLIP}`];
  const [watching, tracking] = [await launch(), await launch(...faked)];
  const viewer = await open(watching, `/?room=${room}&bare=1`, { size: { width: 320, height: 320 } });
  await faceIsThere(viewer.page);
  const { page, errors } = await open(tracking, `/track.html?room=${room}`, { size: { width: 480, height: 800 } });
  let sent = 0;
  page.on("websocket", (socket) => socket.on("framesent", () => (sent += 1)));
  check("the page says that the video stays in the browser", (await text(page, ".private")).includes("never leaves this browser"));
  await page.click("#start");
  await until("a seen face", async () => {
    if (await page.isVisible("#problem")) throw new Error(`the page says: ${await text(page, "#problem")}`);
    return (await text(page, "#seen-text")) === "Face seen";
  });
  check("the tracker sees the face", true);
  await until("publishing", async () => (await text(page, "#publish-text")) === `Publishing to room ${room}.`);
  await live(viewer.page);
  check("the other browser's page says Live", true);
  const pictures = [];
  let most = 0;
  await until("a moving picture", async () => {
    pictures.push(await picture(viewer.page));
    for (const other of pictures) most = Math.max(most, difference(other, pictures.at(-1)));
    return most > 0.8;
  });
  check(`the other browser's picture moves with the film (${most.toFixed(2)} grey levels)`, true);
  const drawn = await page.evaluate(() => {
    const canvas = document.getElementById("overlay");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    return data.filter((value, i) => i % 4 === 3 && value > 0).length;
  });
  check("the points are drawn over the picture", drawn > 400, `${drawn} pixels`);
  await page.click("#calibrate");
  await until("a calibrated face", async () => (await text(page, "#answer")).startsWith("Calibrated"));
  check("calibrate takes the neutral face", true);
  // Out of sight no pictures are presented to a page; its camera goes on all the same.
  await page.evaluate(() => {
    Object.defineProperty(document, "hidden", { get: () => true });
    HTMLVideoElement.prototype.requestVideoFrameCallback = () => 0;
  });
  await page.waitForTimeout(1000);
  const before = sent;
  await until("frames of a page that is out of sight", () => sent > before + 4);
  check("a page that is out of sight goes on publishing", true);
  const asked = Date.now();
  await page.evaluate(() => document.getElementById("stop").click());
  console.log(`# stopped after ${Date.now() - asked} ms`);
  await until("an idle page", () => page.isVisible("#start"));
  check("stop ends the camera", await page.evaluate(() => document.getElementById("video").srcObject === null));
  check("the console says nothing of errors", errors.length === 0, errors.join("; "));
  await watching.close();
  await tracking.close();

  // Headless browsers refuse the camera where nobody can be asked.
  const refusing = await launch("--use-fake-device-for-media-stream");
  const refused = await open(refusing, `/track.html?room=${room}`);
  await refused.page.click("#start");
  await refused.page.waitForSelector("#problem:not([hidden])", { timeout: PATIENCE });
  const said = await text(refused.page, "#problem");
  check("a camera that is not allowed is said to be so", said.includes("was not allowed"), said);
  await refusing.close();

  const blind = await launch("--use-fake-ui-for-media-stream");
  const without = await open(blind, `/track.html?room=${room}`);
  await without.page.click("#start");
  await without.page.waitForSelector("#problem:not([hidden])", { timeout: PATIENCE });
  const words = await text(without.page, "#problem");
  check("a missing camera is said to be missing", words.includes("No camera was found"), words);
  await blind.close();
});
