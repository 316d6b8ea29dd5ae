// The camera page against the real server: binary frames, calibrate, re-centre, settings, the guided fit, its profile. The film's
// talking head makes none of the faces that are asked for: it is refused in words, and steps are left out.
//
// Environment, besides lib.mjs: RHYTID_CLIP, a film of a face.
import { PATIENCE, check, launch, open, roomName, run, text, until } from "./lib.mjs";

await run(async () => {
  const room = roomName("fit");
  const browser = await launch("--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream", `--use-file-for-fake-video-capture=${process.env.RHYTID_CLIP}`);
  const { page, errors } = await open(browser, `/track.html?room=${room}`, { size: { width: 390, height: 844 } });
  const sent = { binary: 0, frames: 0, refused: [] };
  page.on("websocket", (socket) => {
    socket.on("framesent", ({ payload }) => {
      if (typeof payload !== "string") sent.binary += 1;
      else if (payload.includes('"landmarks"')) sent.frames += 1;
    });
    socket.on("framereceived", ({ payload }) => {
      if (typeof payload === "string" && payload.includes('"type":"error"')) sent.refused.push(JSON.parse(payload));
    });
  });
  await page.click("#start");
  await until("binary frames", async () => {
    if (await page.isVisible("#problem")) throw new Error(`the page says: ${await text(page, "#problem")}`);
    return sent.binary >= 5;
  });
  check("points go out as binary frames, none as text", sent.frames === 0);
  const listing = async () => {
    const { rooms } = await (await page.request.get(new URL("/api/rooms", page.url()).href)).json();
    return rooms.find(({ name }) => name === room)?.sources[0];
  };
  await until("a live source", async () => (await listing())?.live);
  check("the server takes them: the webcam is live", (await listing()).source === "webcam");

  await page.click("#calibrate");
  await until("a calibrated face", async () => (await text(page, "#answer")).startsWith("Calibrated"));
  check("calibrate takes the neutral face", true);
  await page.click("#recentre");
  await until("re-centred", async () => (await text(page, "#answer")).includes("straight ahead now"));
  check("re-centre is answered", true);
  await page.click("#settings summary");
  await page.locator("#knob-smoothing-brows").fill("3");
  await until("the server's delay beside the knob", async () => /× 3\.00 · \d+ ms$/.test(await text(page, "#knob-smoothing-brows + output")));
  check(`settings are taken, and their delay comes back (${await text(page, "#knob-smoothing-brows + output")})`, true);

  await page.click("#wizard-open");
  await page.fill("#wizard-name", "talker");
  await page.click("#wizard-buttons >> text=Start");
  const said = [];
  let again = 0;
  await until("the end of the fit", async () => {
    const title = await text(page, "#wizard-title");
    if (title === "Done") return true;
    if (title === "That did not work") throw new Error(await text(page, "#wizard-text"));
    if (title !== "Once more?") return false;
    said.push(await text(page, "#wizard-text"));
    const leave = page.locator("#wizard-buttons >> text=Leave it out");
    // At rest is needed; whoever talks may need another try.
    if (await leave.count()) await leave.click();
    else if ((again += 1) < 4) await page.click("#wizard-buttons >> text=Again");
    else throw new Error(said.at(-1));
    return false;
  }, 2 * PATIENCE);
  check(`faces that are not made are refused in words (${said.length}, e.g. ${said[0]})`, said.some((words) => /the face moved by -?\d+ % of the character's range/.test(words)), said.join("; "));
  check("what was left out is listed", (await text(page, "#wizard-text")).includes("left out"));
  await page.click("#wizard-buttons >> text=Use it");
  check("the profile is in use by its name", (await text(page, "#profile-text")) === "In use: talker.");

  const [file] = await Promise.all([page.waitForEvent("download"), page.locator("#profile-save").click()]);
  await page.setInputFiles("#profile-file", await file.path());
  await until("the file's profile", async () => (await text(page, "#profile-text")) === "In use: talker.");
  await page.click("#stop");
  await page.click("#start");
  await until("publishing with the profile", async () => (await text(page, "#publish-text")) === `Publishing to room ${room}.`);
  await until("a live source again", async () => (await listing())?.live);
  check("the next session starts with the profile", true);
  const others = sent.refused.filter(({ code }) => !code.startsWith("fit_"));
  check("the server refused nothing else", others.length === 0, JSON.stringify(others));
  check("the console says nothing of errors", errors.length === 0, errors.join("; "));
  await browser.close();
});
