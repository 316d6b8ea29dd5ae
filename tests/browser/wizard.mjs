// The camera page's talk with the server: binary frames, settings, re-centring, the guided fit and its profile. The server is
// played by this test, so that every answer can be asked for; the face is a film's.
//
// Environment, besides lib.mjs: RHYTID_CLIP, a film of a face.
import { check, launch, open, roomName, run, text, until } from "./lib.mjs";

await run(async () => {
  const browser = await launch("--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream", `--use-file-for-fake-video-capture=${process.env.RHYTID_CLIP}`);
  const { page, errors } = await open(browser, `/track.html?room=${roomName("wizard")}`, { size: { width: 480, height: 900 } });
  const heard = { hellos: [], frames: [], settings: [], fits: [], profiles: [] };
  let failOnce = "smile";
  await page.routeWebSocket(/\/publish$/, (socket) => {
    const answer = (message) => socket.send(JSON.stringify(message));
    socket.onMessage((data) => {
      if (typeof data !== "string") {
        heard.frames.push(data);
        return;
      }
      const message = JSON.parse(data);
      if (message.type === "hello") {
        heard.hellos.push(message);
        answer({ type: "ready", version: 1, room: "x", session: 1, kept_neutral: false, character: "Default", bones: [] });
      } else if (message.type === "settings") {
        heard.settings.push(message);
        answer({ ...message, added_delay: { brows: 0.012 * message.smoothing.brows, eyelids: 0.01, mouth: 0.02, head: 0.03 } });
      } else if (message.type === "recentre") {
        answer({ type: "recentred" });
      } else if (message.type === "profile") {
        heard.profiles.push(message.profile);
        answer({ type: "profile", profile: message.profile, warnings: [], offers: {} });
      } else if (message.type === "fit" && message.step === "finish") {
        answer({ type: "profile", profile: { rhytid_profile: 1, name: "tester", ranges: { browInnerUp: 1.4 } }, warnings: ["the blink was not seen clearly"], offers: { swap_jaw: true } });
      } else if (message.type === "fit") {
        heard.fits.push(message.step);
        const fails = message.step === failOnce;
        if (fails) failOnce = "";
        setTimeout(() => answer(fails
          ? { type: "error", code: "moved_too_little", message: "the mouth moved too little: smile more broadly" }
          : { type: "fit", step: message.step, done: true, frames: 40 }), 1000 * message.seconds);
      }
    });
  });

  await page.click("#start");
  await until("binary frames", async () => {
    if (await page.isVisible("#problem")) throw new Error(`the page says: ${await text(page, "#problem")}`);
    return heard.frames.length >= 3;
  });
  const [hello] = heard.hellos;
  check("the hello says who, what layout and what picture", hello.source === "webcam" && hello.layout === "mediapipe478" && hello.image.length === 2 && hello.image.every((side) => side > 100), JSON.stringify(hello));
  const frame = heard.frames.at(-1);
  const [kind, count] = [frame.readUInt8(0), frame.readUInt16LE(2)];
  check("frames are binary and hold 478 points with z", kind === 1 && count === 478 && frame.length === 2896, `${frame.length} bytes`);
  const step = frame.readFloatLE(24);
  const at = (point, axis) => frame.readFloatLE(12 + 4 * axis) + step * frame.readUInt16LE(28 + 2 * (3 * point + axis));
  const [width, height] = hello.image;
  check("points are pixels of the picture", at(4, 0) > 0.1 * width && at(4, 0) < 0.9 * width && at(4, 1) > 0.1 * height && at(4, 1) < 0.9 * height);
  check("the nose is nearer than the ear", at(4, 2) < at(234, 2));
  check("the person's left eye is at the picture's right: nothing is mirrored on the way", at(263, 0) > at(33, 0));
  const captured = heard.frames.map((bytes) => bytes.readDoubleLE(4));
  check("times increase", captured.every((t, i) => i === 0 || t > captured[i - 1]));

  // Settings.
  await page.click("#settings summary");
  await page.locator("#knob-smoothing-brows").fill("2");
  await until("settings", () => heard.settings.at(-1)?.smoothing.brows === 2);
  await until("the delay beside the knob", async () => (await text(page, "#knob-smoothing-brows + output")).endsWith("24 ms"));
  check("the delay that smoothing adds stands beside its knob", true);
  await page.check("text=Mirror: my left");
  await until("mirroring", () => heard.settings.at(-1)?.mirror === true);
  check("mirror is told live", true);
  await page.click("#recentre");
  await until("re-centred", async () => (await text(page, "#answer")).includes("straight ahead now"));
  check("re-centre is answered", true);

  // The guided fit.
  const started = Date.now();
  await page.click("#wizard-open");
  await page.click("#wizard-buttons >> text=Start");
  await until("a refused smile", async () => (await text(page, "#wizard-title")) === "Once more?");
  check("what went wrong is said", (await text(page, "#wizard-text")).includes("moved too little"));
  await page.click("#wizard-buttons >> text=Again");
  await until("the end of the fit", async () => (await text(page, "#wizard-title")) === "Done");
  const took = (Date.now() - started) / 1000;
  const wanted = ["neutral", "brows_up", "frown", "smile", "smile", "pucker", "jaw_open", "blink", "mouth_left"];
  check("the eight faces are asked for in their order, the smile twice", heard.fits.join() === wanted.join(), heard.fits.join());
  check(`it took ${took.toFixed(0)} s`, took > 19 && took < 80);
  check("warnings are shown", (await text(page, "#wizard-text")).includes("blink was not seen"));
  check("an offered swap can be taken", (await text(page, "#wizard-text")).includes("swap its left and right"));
  await page.click("#wizard-buttons >> text=Use it");
  await until("the swap among the settings", () => heard.settings.at(-1)?.swap_jaw === true);
  check("the profile is named on the page", (await text(page, "#profile-text")).includes("tester"));
  const [file] = await Promise.all([page.waitForEvent("download"), page.click("#profile-save")]);
  check("the profile can be saved as a file", file.suggestedFilename() === "tester.json");

  await page.click("#stop");
  await page.click("#start");
  await until("a second hello", () => heard.hellos.length >= 2);
  check("the next session brings profile and settings with its hello", heard.hellos.at(-1).profile?.name === "tester" && heard.hellos.at(-1).settings.swap_jaw === true);

  const choose = async (text) => page.setInputFiles("#profile-file", { name: "p.json", mimeType: "application/json", buffer: Buffer.from(text) });
  await choose("{ nonsense");
  await until("a refused file", async () => (await text(page, "#profile-text")).includes("not JSON"));
  await choose('{"rhytid_profile":2}');
  await until("a refused version", async () => (await text(page, "#profile-text")).includes("version 1"));
  check("files that are no profiles are refused in words", true);
  await choose('{"rhytid_profile":1,"name":"from a file"}');
  await until("a loaded file", async () => (await text(page, "#profile-text")).includes("from a file"));
  check("a profile can be loaded from a file", heard.profiles.at(-1).name === "from a file");
  check("the console says nothing of errors", errors.length === 0, errors.join("; "));
  await browser.close();
});
