// What every browser test needs: a browser, pages that tell of their errors, pictures that can be compared.
//
// Environment: RHYTID_URL the server, RHYTID_NODE_MODULES where playwright-core is, RHYTID_CHROMIUM the browser,
// RHYTID_CHROMIUM_FLAGS more flags for it, between spaces.

import { createRequire } from "node:module";
import path from "node:path";
import { fileURLToPath } from "node:url";

const here = path.dirname(fileURLToPath(import.meta.url));

/** A package of npm that the project does not carry. */
export function required(name) {
  const modules = process.env.RHYTID_NODE_MODULES ?? path.join(here, "../../target/npm/node_modules");
  return createRequire(path.join(modules, "x.js"))(name);
}

export const URL_OF_SERVER = process.env.RHYTID_URL ?? "http://127.0.0.1:7878";
/** How long a slow machine may take for one step, milliseconds. */
export const PATIENCE = 90_000;

const FLAGS = [
  "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
  "--enable-unsafe-swiftshader",
];

/** WebGPU without a GPU. A canvas of it reaches the page only where the browser itself draws with the same software Vulkan. */
export const WEBGPU = [
  "--enable-unsafe-webgpu", "--use-webgpu-adapter=swiftshader", "--enable-features=Vulkan", "--use-vulkan=swiftshader",
  "--use-angle=vulkan",
];

/** A browser without a window. */
export function launch(...flags) {
  const { chromium } = required("playwright-core");
  const more = (process.env.RHYTID_CHROMIUM_FLAGS ?? "").split(" ").filter(Boolean);
  return chromium.launch({ executablePath: process.env.RHYTID_CHROMIUM ?? "/usr/bin/chromium", args: [...FLAGS, ...more, ...flags] });
}

let numFailed = 0;

/** One fact, as a line of TAP. */
export function check(what, isTrue, detail = "") {
  console.log(`${isTrue ? "ok" : "not ok"} - ${what}${isTrue || !detail ? "" : `: ${detail}`}`);
  if (!isTrue) numFailed += 1;
}

/** Runs a test to its end: exit 1 where a fact was none, or where it could not go on. */
export async function run(test) {
  try {
    await test();
  } catch (error) {
    console.log(`not ok - the test went to its end: ${String(error.message ?? error).split("\n")[0]}`);
    if (process.env.RHYTID_VERBOSE) console.error(error);
    numFailed += 1;
  }
  process.exit(numFailed ? 1 : 0);
}

/** Opens a page; `errors` collects what its console says is wrong. */
export async function open(browser, address, { size = { width: 640, height: 480 }, context } = {}) {
  const page = await (context ?? browser).newPage(context ? {} : { viewport: size });
  if (context) await page.setViewportSize(size);
  page.setDefaultTimeout(PATIENCE);
  const errors = [];
  page.on("pageerror", (error) => errors.push(error.message));
  page.on("console", (message) => {
    if (message.type() === "error") errors.push(message.text());
  });
  await page.goto(new URL(address, URL_OF_SERVER).href);
  return { page, errors };
}

/** Waits until `probe` gives something true. */
export async function until(what, probe, patience = PATIENCE) {
  const end = Date.now() + patience;
  for (;;) {
    const value = await probe();
    if (value) return value;
    if (Date.now() > end) throw new Error(`within ${patience / 1000} s ${what} did not come`);
    await new Promise((resolve) => setTimeout(resolve, 150));
  }
}

/** The text of an element. */
export const text = (page, selector) => page.locator(selector).first().textContent();

/** A face has been drawn: the page has a backend and no complaint. */
export async function faceIsThere(page) {
  await until("a drawn face", async () => {
    if ((await text(page, "#state-text")) === "Cannot show the face") throw new Error(`the page says: ${await text(page, "#notice-text")}`);
    return page.evaluate(() => Boolean(document.documentElement.dataset.backend) && document.querySelector("#views button"));
  });
}

/** Waits until the page says that the room is live. */
export const live = (page) => until("the state Live", async () => (await text(page, "#state-text")) === "Live");

/** What the canvas shows, as grey levels. `page` may have controls in front of it: a bare one has none. */
export async function picture(page) {
  const png = (await page.locator("#face").screenshot({ timeout: PATIENCE })).toString("base64");
  return page.evaluate(async (base64) => {
    const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
    const bitmap = await createImageBitmap(new Blob([bytes], { type: "image/png" }));
    const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
    const context = canvas.getContext("2d");
    context.drawImage(bitmap, 0, 0);
    const { data } = context.getImageData(0, 0, bitmap.width, bitmap.height);
    const grey = [];
    for (let i = 0; i < data.length; i += 4) grey.push(Math.round((data[i] + data[i + 1] + data[i + 2]) / 3));
    return { width: bitmap.width, height: bitmap.height, grey };
  }, png);
}

/** Mean difference of two pictures in grey levels over a part given in fractions. */
export function difference(a, b, [left, top, right, bottom] = [0, 0, 1, 1]) {
  if (a.width !== b.width || a.height !== b.height) throw new Error("the pictures are of two sizes");
  let sum = 0;
  let count = 0;
  for (let y = Math.floor(top * a.height); y < bottom * a.height; y += 1) {
    for (let x = Math.floor(left * a.width); x < right * a.width; x += 1) {
      sum += Math.abs(a.grey[y * a.width + x] - b.grey[y * a.width + x]);
      count += 1;
    }
  }
  return sum / count;
}

/** A room of this test's own. */
export const roomName = (stem) => `${stem}-${Date.now().toString(36)}-${Math.floor(Math.random() * 1e6).toString(36)}`;

/** The steps of the guided fit, in their order. */
export const STEPS = ["neutral", "brows_up", "frown", "smile", "pucker", "jaw_open", "blink", "mouth_left"];
const TITLES = ["Face at rest", "Brows up", "Frown", "Smile", "Pucker", "Mouth wide open", "Close your eyes", "Mouth to your left"];

/** Somebody with expression weights who makes the fit's faces half as far as a character, and whose mouth goes to the side called the other. */
const FACES = {
  neutral: {},
  brows_up: { browInnerUp: 0.5, browOuterUpLeft: 0.5, browOuterUpRight: 0.5 },
  frown: { browDownLeft: 0.5, browDownRight: 0.5 },
  smile: { mouthSmileLeft: 0.5, mouthSmileRight: 0.5 },
  pucker: { mouthPucker: 0.5 },
  jaw_open: { jawOpen: 0.5 },
  blink: { eyeBlinkLeft: 0.5, eyeBlinkRight: 0.5 },
  mouth_left: { mouthRight: 0.5 },
};

/** A publisher of weights at 30 frames a second, in a page of its own that draws nothing. `make` a step's face; `close` it. */
export async function actor(browser, room, hello) {
  const { page } = await open(browser, "/healthz");
  await page.evaluate(async ([address, first]) => {
    const socket = new WebSocket(address, "rhytid.v1");
    await new Promise((resolve, reject) => Object.assign(socket, { onopen: resolve, onerror: reject }));
    socket.send(JSON.stringify({ type: "hello", version: 1, fps: 30, ...first }));
    const ready = await new Promise((resolve) => { socket.onmessage = ({ data }) => resolve(data); });
    if (!ready.includes('"ready"')) throw new Error(ready);
    window.weights = {};
    window.socket = socket;
    setInterval(() => socket.send(JSON.stringify({ type: "frame", t: performance.now() / 1000, weights: window.weights })), 33);
  }, [`${URL_OF_SERVER.replace(/^http/, "ws")}/v1/rooms/${room}/publish`, hello]);
  return { make: (step) => page.evaluate((weights) => { window.weights = weights; }, FACES[step]), close: () => page.close() };
}

/** A viewer of JSON; `frame` gives the newest frame, null before the first. */
export async function watcher(browser, room) {
  const { page } = await open(browser, "/healthz");
  await page.evaluate((address) => {
    window.newest = null;
    new WebSocket(address, "rhytid.v1").onmessage = ({ data }) => {
      const message = JSON.parse(data);
      if (message.type === "frame") window.newest = message;
    };
  }, `${URL_OF_SERVER.replace(/^http/, "ws")}/v1/rooms/${room}/view?format=json`);
  return { frame: () => page.evaluate(() => window.newest) };
}

/** Makes the faces that the page's wizard asks for until it is done; gives the steps it asked for. */
export async function followWizard(page, performer) {
  const asked = [];
  await until("the end of the fit", async () => {
    const title = await text(page, "#wizard-title");
    if (title === "Done") return true;
    const step = STEPS[TITLES.indexOf(title)];
    if (!step) throw new Error(`the fit says ${title}: ${await text(page, "#wizard-text")}`);
    if (asked.at(-1) !== step) {
      asked.push(step);
      await performer.make(step);
    }
    return false;
  });
  return asked;
}
