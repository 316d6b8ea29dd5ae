// The sources' tab: a phone's tracker and a headset's socket drive one face; who drives what is listed, and both are told from the
// page what they cannot be told themselves: neutral, straight ahead, settings, the guided fit, a profile.
//
// Environment, besides lib.mjs: RHYTID_SERVER the server's program, RHYTID_UDP the port that takes Live Link Face's datagrams for the
// room "stage", slot "phone", priority 60; RHYTID_WORK a folder to write to.
import { spawn } from "node:child_process";
import fs from "node:fs";
import path from "node:path";
import { STEPS, actor, check, faceIsThere, followWizard, launch, open, run, text, until, watcher } from "./lib.mjs";

const room = "stage";

/** A phone whose face holds its brows up and bows, and opens and shuts its mouth. */
function startPhone() {
  let feed = '{"type":"hello","version":1,"source":"test"}\n';
  for (let i = 0; i < 1200; i += 1) {
    const t = i / 60;
    const weights = { jawOpen: 0.5 - 0.5 * Math.cos(6 * t), browInnerUp: 0.4 };
    feed += `${JSON.stringify({ type: "frame", t, weights, head: { rotation: [0.1, 0, 0, Math.sqrt(0.99)], position: [0, 0, 0] } })}\n`;
  }
  const file = path.join(process.env.RHYTID_WORK, "phone.jsonl");
  fs.writeFileSync(file, feed);
  const phone = spawn(process.env.RHYTID_SERVER, ["fake", file, "--as", "livelink", "--to", process.env.RHYTID_UDP, "--loop"], { stdio: "ignore" });
  process.on("exit", () => phone.kill("SIGKILL"));
  return phone;
}

await run(async () => {
  const phone = startPhone();
  const browser = await launch();
  const headset = await actor(browser, room, { source: "headset", slot: "headset" });
  const seen = await watcher(browser, room);
  const { page, errors } = await open(browser, `/?room=${room}`, { size: { width: 780, height: 520 } });
  await faceIsThere(page);
  if (!(await page.isVisible("#panel"))) await page.keyboard.press("h");
  await page.click("#tab-sources");

  const card = (slot) => page.locator(`.source[data-slot="${slot}"]`);
  const driven = async (slot) => (await card(slot).locator(".drives").evaluateAll((all) => all.map((item) => item.dataset.group))).join();
  await until("two sources", async () => (await text(page, "#page-sources > p")) === "2 sources, 2 live");
  check("the list has both, the one of the higher priority first", (await page.locator(".source").evaluateAll((all) => all.map((item) => item.dataset.slot))).join() === "phone,headset");
  check("each says what it calls itself", (await text(page, '.source[data-slot="phone"] h3')).startsWith("livelink") && (await text(page, '.source[data-slot="headset"] h3')) === "headset");
  check("slot and priority are said", (await card("phone").textContent()).includes("slot phone · priority 60"));
  await until("the phone driving all", async () => (await driven("phone")) === "brows,lids,gaze,mouth,head");
  check("the source of the higher priority drives the face, the other nothing", (await driven("headset")) === "");
  check("who cannot see the colours is told, too", (await card("headset").locator("[data-group=brows]").textContent()) === "Brows: not driven");

  // A phone that is told from here.
  await until("a bowed head", async () => (await seen.frame())?.head.rotation[0] > 0.08);
  await card("phone").locator('[data-do="recentre"]').click();
  await until("a head that is straight again", async () => Math.abs((await seen.frame()).head.rotation[0]) < 0.02);
  check("re-centre reaches the phone's head", (await card("phone").textContent()).includes("straight ahead now"));
  await card("phone").locator("summary").click();
  const knob = (slot, name) => page.locator(`#source-${slot}-knob-${name}`);
  await until("the delay beside the knob", async () => / ms$/.test(await knob("phone", "smoothing-brows").locator("+ output").textContent()));
  const delay = async () => Number(/(\d+) ms$/.exec(await knob("phone", "smoothing-brows").locator("+ output").textContent())[1]);
  await until("a delay of brows that are held still", async () => (await delay()) > 0);
  const before = await delay();
  await knob("phone", "smoothing-brows").fill("3");
  await until("a longer delay", async () => (await delay()) > 1.5 * before);
  check(`smoothing tells the delay that it adds (${before} and ${await delay()} ms)`, true);
  await card("phone").locator('[data-do="calibrate"]').click();
  await until("an answer", async () => (await card("phone").textContent()).includes("taken as neutral"));
  check("neutral reaches the phone", true);
  await knob("phone", "gains-mouth").fill("0");
  let still = 0;
  await until("a mouth that stays shut", async () => {
    still = ((await seen.frame()).shapes.jawOpen ?? 0) < 0.02 ? still + 1 : 0;
    return still > 8;
  });
  check("a strength of 0 stills the phone's mouth", true);
  await card("phone").locator("text=Back to the defaults").click();
  await until("a mouth that opens", async () => (await seen.frame()).shapes.jawOpen > 0.5);
  check("the defaults bring it back", true);

  // By keys alone.
  await page.locator("#tab-sources").focus();
  const reached = [];
  for (let i = 0; i < 40; i += 1) {
    await page.keyboard.press("Tab");
    reached.push(await page.evaluate(() => document.activeElement?.dataset.do ?? document.activeElement?.tagName ?? ""));
  }
  check("Tab reaches every button", reached.filter((name) => ["calibrate", "recentre", "fit"].includes(name)).length >= 6, reached.join());
  const focused = card("headset").locator('[data-do="fit"]');
  await focused.focus();
  await page.waitForTimeout(2500);
  check("a list that is looked at again keeps the focus", await focused.evaluate((button) => button === document.activeElement));

  // The guided fit of the headset, whose wearer goes half as far as the character.
  await page.keyboard.press("Enter");
  check("Enter opens the fit", (await text(page, "#wizard-title")) === "Fit the performer");
  check("it says who must see the page", (await text(page, "#wizard-text")).includes("in front of headset must see this page"));
  await page.fill("#wizard-name", "no name");
  await page.click("#wizard-buttons >> text=Start");
  check("a name that cannot be one is refused in words", (await text(page, "#wizard-wrong")).includes("letters, digits"));
  await page.fill("#wizard-name", "ada");
  await page.click("#wizard-buttons >> text=Start");
  const asked = await followWizard(page, headset);
  check("the eight faces are asked for", asked.join() === STEPS.join(), asked.join());
  check("the profile is in use and kept by its name", (await text(page, "#wizard-text")).includes("keeps it as “ada”"), await text(page, "#wizard-text"));
  check("a side that is swapped is offered to be put right", (await text(page, "#wizard-text")).includes("swap its left and right"), await text(page, "#wizard-text"));
  const [file] = await Promise.all([page.waitForEvent("download"), page.click("#wizard-buttons >> text=Save as a file")]);
  const saved = JSON.parse(fs.readFileSync(await file.path(), "utf8"));
  check("the profile as a file says how far the face goes", saved.rhytid_profile === 1 && saved.name === "ada" && Math.abs(saved.ranges.smile - 2) < 0.05, JSON.stringify(saved.ranges));
  await page.click("#wizard-buttons >> text=Use it");
  const kept = await (await page.request.get(new URL("/api/profiles", page.url()).href)).json();
  check("the server lists it", kept.profiles.some(({ name, source }) => name === "ada" && source === "headset"), JSON.stringify(kept));

  // The phone goes: the headset drives, stretched by its profile.
  phone.kill("SIGTERM");
  await headset.make("smile");
  await until("the headset driving", async () => (await driven("headset")) === "brows,lids,gaze,mouth,head");
  await until("a stretched smile", async () => (await seen.frame()).shapes.mouthSmileLeft > 0.9);
  check("a smile of half the range is a whole one", true);
  const silent = (await card("phone").count()) === 0 || (await card("phone").locator(".badge").textContent()) === "Silent";
  check("the phone is silent or gone", silent);

  // A profile by hand.
  await card("headset").locator("summary").click();
  const details = card("headset").locator("details");
  await until("the list of profiles", async () => (await details.locator("select option").count()) === 2);
  await details.locator("input[type=file]").setInputFiles({ name: "p.json", mimeType: "application/json", buffer: Buffer.from('{"rhytid_profile":7}') });
  await until("a refused file", async () => (await details.textContent()).includes("not a profile of version 1"));
  check("a file that is no profile is refused in words", true);
  const plain = JSON.stringify({ ...saved, name: "plain", ranges: {} });
  await details.locator("input[type=file]").setInputFiles({ name: "p.json", mimeType: "application/json", buffer: Buffer.from(plain) });
  await until("the file's profile", async () => (await details.textContent()).includes("In use: plain"));
  await until("a smile of half the range", async () => Math.abs((await seen.frame()).shapes.mouthSmileLeft - 0.5) < 0.03);
  check("a profile from a file is used", true);
  await details.locator("select").selectOption("ada");
  await until("the kept profile", async () => (await seen.frame()).shapes.mouthSmileLeft > 0.9);
  await until("its name", async () => (await details.textContent()).includes("In use: ada"));
  check("a profile that the server keeps is used", true);
  const [again] = await Promise.all([page.waitForEvent("download"), details.locator("text=Save as a file").click()]);
  check("it can be saved as a file", again.suggestedFilename() === "ada.json");

  // Nobody any more, and another room.
  await headset.close();
  await until("no source", async () => (await text(page, "#page-sources > p")).startsWith("Nobody sends"));
  check("a room without sources says so", (await page.locator(".source").count()) === 0);
  check("the console says nothing of errors", errors.length === 0, errors.join("; "));
  await browser.close();
});
