// The page that shows a room's face. What there is to see is drawn by the Rust client in WebAssembly; here are the sockets, the
// controls and the words.

import { Inspector } from "./inspect.js";
import { Panel } from "./panel.js";
import { Puppet } from "./puppet.js";
import { RoomPicker } from "./rooms.js";
import { listenForCopies, showLinks } from "./share.js";
import { Sources } from "./sources.js";
import { Stage, expressionNames, fetchCharacter } from "./stage.js";
import { Takes } from "./takes.js";
import { byId, element, roomOfAddress, storage, wallClock } from "./util.js";
import { ViewLink } from "./view_link.js";
import { FaceViewer } from "./viewer.js";
import { PacketTimes } from "./wire.js";

const parameters = new URLSearchParams(location.search);
const isBare = parameters.get("bare") === "1";
const isTransparent = parameters.get("background") === "transparent";
/** Milliseconds between two looks at the viewer's numbers. */
const NUMBERS = 500;

/** The views that have a key of their own, in the order of the keys 1 to 6. */
const VIEWS = ["beauty", "bare", "split", "influence", "normals", "wireframe"];
const CHOICES = {
  wrinkles: [["own", "Automatic"], ["bones", "Poses"], ["zones", "Zones"], ["both", "Both"], ["off", "Off"]],
  light: [["portrait", "Portrait"], ["sunset", "Sunset"]],
  deform: [["bones", "Bones"], ["shapes", "Shapes"]],
};
const BLENDS = ["pd", "simple", "printed"];
const KEYS = [
  [["1", "–", "6"], "Views: beauty, bare, split, influence (again: one pose after another), normals, wireframe"],
  [["W"], "Wrinkles on and off"],
  [["Z"], "Which wrinkles: poses, zones, both"],
  [["B"], "How wrinkles are blended"],
  [["L"], "Light"],
  [["D"], "Bones or shapes move the face"],
  [["R"], "Look from the front"],
  [["H"], "Controls"],
  [["P"], "Next page of the controls"],
  [["F"], "Full screen"],
  [["Space"], "Replay: play and pause"],
  [["C"], "Camera: take this face as neutral"],
  [["X"], "Camera: this is straight ahead"],
  [["?"], "This list"],
];

/** @type {FaceViewer | null} */
let viewer = null;
/** @type {ViewLink | null} */
let link = null;
let linkState = "connecting";
let linkDetail = "";
let room = roomOfAddress();
/** The character of the last hello. @type {any} */
let character = null;
let problem = "";
/** Why the face is not drawn for the moment. */
let redrawing = "";
let view = "beauty";
let poseShown = -1;
let wrinklesBefore = "own";
let blend = 0;
const times = new PacketTimes();

const takes = isBare ? null : new Takes();
const panel = new Panel(["camera", "puppet", "sources", "inspect", "takes", "share"], (name) => shownTab(name));
const inspector = new Inspector(byId("page-inspect"));
const puppet = new Puppet(byId("page-puppet"), (t, sent) => inspector.frameSent(t, sent, sent));
const sources = new Sources(byId("page-sources"), room);
const picker = new RoomPicker((name) => enter(name, true));

function shownTab(/** @type {string | null} */ name) {
  // Called by the panel before what follows it is there.
  queueMicrotask(() => {
    inspector.setOpen(name === "inspect");
    sources.setOpen(name === "sources");
    if (name === "camera") openCamera();
    if (name === "share") showLinks(room);
    takes?.setOpen(name === "takes");
  });
}

// The camera page stands in a frame of its own: its tracker needs rights that this page does not have.
function cameraFrame() {
  return /** @type {HTMLIFrameElement | null} */ (byId("camera-frame").querySelector("iframe"));
}

function openCamera() {
  if (cameraFrame()) return;
  const frame = element("iframe", { src: `/track.html?room=${room}&embedded=1`, title: "Camera", allow: "camera; fullscreen; clipboard-write" });
  byId("camera-frame").append(frame);
}

function tellCamera(/** @type {Record<string, any>} */ message) {
  cameraFrame()?.contentWindow?.postMessage({ from: "rhytid", ...message }, location.origin);
}

addEventListener("message", ({ origin, data, source }) => {
  if (origin !== location.origin || source !== cameraFrame()?.contentWindow || data?.from !== "rhytid") return;
  if (data.type === "sent") {
    inspector.frameSent(data.t, data.captured, data.sent);
    inspector.pointsSeen(data.points, performance.now() / 1000);
  } else if (data.type === "expand") {
    byId("camera-frame").classList.toggle("expanded", data.isOn);
  } else if (data.type === "key") {
    obey(data.key);
  }
});

/** Goes to a room. @param {string} name @param {boolean} isNew whether the address must change */
function enter(name, isNew) {
  if (isNew && name === room) return;
  room = name;
  if (isNew) {
    const address = new URL(location.href);
    address.searchParams.set("room", name);
    history.pushState(null, "", address);
  }
  byId("room-name").textContent = name;
  document.title = `${name} · Rhytid`;
  picker.current = name;
  puppet.enter(name);
  sources.enter(name);
  takes?.enter(name);
  tellCamera({ type: "room", room: name });
  if (!byId("page-share").hidden) showLinks(name);
  link?.close();
  viewer?.linkLost();
  problem = "";
  openLink();
}

function openLink() {
  link = new ViewLink(room, {
    hello: (text) => greeted(text),
    packet: (bytes) => {
      const now = performance.now();
      if (viewer) viewer.packet(bytes, now);
      // A delta needs the key before it and nothing between.
      else early = (bytes[0] ?? 0) & 1 ? [...early.slice(0, 1), bytes] : [bytes];
      const read = times.read(bytes);
      if (read) inspector.packetArrived(read.micros, wallClock());
    },
    state: (state, detail) => {
      if (state === "lost" && linkState === "open") viewer?.linkLost();
      linkState = state;
      linkDetail = detail;
      showState();
    },
  });
}

/** Packets that came before there was a viewer: the last key and the newest one after it. @type {Uint8Array[]} */
let early = [];
/** The last hello, until there is a viewer to take it. */
let earlyHello = "";

/** The view socket's hello: on to its character. @param {string} text */
async function greeted(text) {
  const current = viewer;
  if (!current) {
    earlyHello = text;
    early = [];
    fetched(JSON.parse(text).character);
    return;
  }
  try {
    const hello = JSON.parse(text);
    current.hello(text);
    for (const bytes of early.splice(0)) current.packet(bytes, performance.now());
    const isOther = hello.character.sha256 !== character?.sha256;
    character = hello.character;
    if (hello.character.sha256 !== current.loadedHash) {
      const glb = await fetched(hello.character);
      performance.mark("rhytid:fetched");
      // Another hello may have come meanwhile, or another viewer.
      const isWanted = () => character?.sha256 === hello.character.sha256 && current === viewer;
      if (!isWanted() || !(await current.load(glb, hello.character.sha256, isWanted))) return;
      puppet.setExpressions(expressionNames(glb));
    }
    if (isOther) {
      puppet.setCharacter(character);
      inspector.setCharacter(character);
      poseShown = -1;
    }
    view = current.view;
    showViews();
    markView();
    problem = "";
  } catch (error) {
    problem = sentence(error);
  }
  showState();
}

/** A character that is being fetched, perhaps while the viewer is still being loaded. @type {{sha256: string, glb: Promise<Uint8Array>} | null} */
let fetching = null;

/** @param {{url: string, sha256: string}} wanted @returns {Promise<Uint8Array>} */
function fetched(wanted) {
  if (fetching?.sha256 !== wanted.sha256) {
    const glb = fetchCharacter(wanted);
    // Whoever awaits it hears of its failure; it is tried anew then.
    glb.catch(() => { fetching = null; });
    fetching = { sha256: wanted.sha256, glb };
  }
  const { glb } = fetching;
  // Taken once: 6 MB are not kept for nothing.
  if (viewer) fetching = null;
  return glb;
}

/** Times at which the graphics device was lost lately, milliseconds. @type {number[]} */
let losses = [];
/** Losses within a minute after which a person must ask for more: a broken driver would be asked for ever. */
const MOST_LOSSES = 4;

/** The graphics device is gone: another is asked for, on a fresh canvas, since the old one stays with the old device. @param {unknown} error */
function drawingFailed(error) {
  const now = performance.now();
  losses = [...losses.filter((at) => now - at < 60_000), now];
  const words = sentence(error).replace(/\.$/, "");
  if (losses.length > MOST_LOSSES) {
    problem = `${words}. Load the page again to try once more.`;
    showState();
    return;
  }
  redrawing = `${words}. Drawing begins again.`;
  showState();
  // A driver that has just been reset needs a moment, each time a longer one.
  setTimeout(drawAgain, 400 * 2 ** losses.length);
}

async function drawAgain() {
  const old = byId("face");
  const fresh = /** @type {HTMLCanvasElement} */ (old.cloneNode());
  const hadFocus = document.activeElement === old;
  old.replaceWith(fresh);
  if (hadFocus) fresh.focus();
  const before = viewer;
  viewer = null;
  before?.close();
  link?.close();
  try {
    await openViewer(fresh, before);
  } catch (error) {
    drawingFailed(error);
    return;
  }
  redrawing = "";
  // Another room may have been entered meanwhile.
  link?.close();
  // The room says hello again: the face as it is, whole.
  openLink();
  showState();
}

/** Most characters of a complaint that are shown. */
const MOST_SAID = 240;

/** @param {unknown} error */
function sentence(error) {
  const whole = error instanceof Error ? error.message : String(error);
  const text = whole.length > MOST_SAID ? `${whole.slice(0, MOST_SAID)}…` : whole;
  return text.charAt(0).toUpperCase() + text.slice(1);
}

// How things stand, in words.

const WORDS = {
  connecting: ["idle", "Connecting", ""],
  waiting: ["idle", "Waiting for a face", "Nobody publishes to this room yet. Start the camera, move a slider under Puppet, or send with a tracker."],
  live: ["live", "Live", ""],
  lost: ["warn", "Face lost", "The tracker is there but sees no face."],
  silent: ["warn", "Sender silent", "No frame has come for a moment."],
  idle: ["idle", "Sender gone", "Waiting for somebody to publish to this room."],
  gone: ["bad", "Reconnecting", ""],
  refused: ["bad", "Refused", ""],
  redrawing: ["warn", "Drawing again", ""],
  unusable: ["bad", "Cannot show the face", ""],
};
let shownState = "";

function showState() {
  let kind = "connecting";
  let detail = "";
  if (problem) [kind, detail] = ["unusable", problem];
  else if (redrawing) [kind, detail] = ["redrawing", redrawing];
  else if (linkState === "refused") [kind, detail] = ["refused", linkDetail];
  else if (linkState === "lost" || (linkState === "connecting" && (link?.backoff.attempts ?? 0) > 0)) {
    [kind, detail] = ["gone", linkDetail || "The server does not answer"];
  } else if (linkState === "open") {
    const state = viewer ? viewer.stats().state : "connecting";
    kind = state in WORDS ? state : "waiting";
  }
  const [color, headline, text] = WORDS[/** @type {keyof typeof WORDS} */ (kind)];
  const shown = kind + detail;
  if (shown === shownState) return;
  shownState = shown;
  byId("state").dataset.kind = color;
  byId("state-text").textContent = headline;
  const isQuiet = kind === "live" || kind === "connecting" || (isBare && color === "idle");
  byId("notice").hidden = isQuiet;
  if (isQuiet) return;
  byId("notice").dataset.kind = color;
  byId("notice-title").textContent = headline;
  byId("notice-text").textContent = detail || text;
}

function showNumbers() {
  showState();
  const stats = viewer?.stats();
  if (!stats) return;
  const isMoving = linkState === "open" && stats.bytesPerSecond > 0;
  byId("number-fps").textContent = stats.fps < 9.95 ? stats.fps.toFixed(1) : String(Math.round(stats.fps));
  byId("number-latency").textContent = isMoving ? `${Math.round(stats.latencyMs + stats.drawMs)} ms` : "–";
  const bytes = isMoving ? stats.bytesPerSecond : 0;
  byId("number-bytes").textContent = bytes < 1000 ? `${Math.round(bytes)} B/s` : `${(bytes / 1000).toFixed(1)} kB/s`;
}

// Switches.

function showViews() {
  const known = viewer?.views() ?? [];
  const all = known.length ? known : VIEWS;
  // Those with a key first; the terms of the light are one press further.
  const names = [...VIEWS.filter((name) => all.includes(name)), ...all.filter((name) => !VIEWS.includes(name) && !name.includes(":"))];
  const group = byId("views");
  if (group.dataset.names === names.join()) return;
  group.dataset.names = names.join();
  group.replaceChildren(...names.map((name) => {
    const key = VIEWS.indexOf(name) + 1;
    const button = element("button", { role: "radio", "aria-checked": "false", "data-view": name, title: key ? `Key ${key}` : "", onclick: () => chooseView(name) },
      name.charAt(0).toUpperCase() + name.slice(1));
    button.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
      const step = { ArrowRight: 1, ArrowDown: 1, ArrowLeft: -1, ArrowUp: -1 }[event.key];
      if (!step) return;
      event.preventDefault();
      const next = names[(names.indexOf(name) + step + names.length) % names.length];
      chooseView(next);
      /** @type {HTMLElement | null} */ (group.querySelector(`[data-view="${next}"]`))?.focus();
    });
    return button;
  }));
  markView();
}

function markView() {
  for (const button of byId("views").children) {
    const isOn = /** @type {HTMLElement} */ (button).dataset.view === view;
    button.setAttribute("aria-checked", String(isOn));
    /** @type {HTMLElement} */ (button).tabIndex = isOn ? 0 : -1;
    if (view === "influence" && isOn) {
      const pose = character?.poses[poseShown]?.name;
      button.textContent = pose ? `Influence: ${pose}` : "Influence";
    } else if (/** @type {HTMLElement} */ (button).dataset.view === "influence") {
      button.textContent = "Influence";
    }
  }
  byId("split-captions").hidden = view !== "split";
}

/** Shows a view; the influence chosen again goes on to the next pose. @param {string} name */
function chooseView(name) {
  if (!viewer) return;
  if (name === "influence" && view === "influence") {
    const most = character?.poses.length ?? 0;
    poseShown = poseShown + 1 < most ? poseShown + 1 : -1;
  }
  const pose = name === "influence" ? character?.poses[poseShown]?.name : undefined;
  try {
    viewer.setView(pose ? `influence:${pose}` : name);
    view = name;
  } catch (error) {
    poseShown = -1;
    console.warn(sentence(error));
  }
  markView();
}

/** @param {"wrinkles" | "light" | "deform"} name @param {string} value @param {boolean} isKept */
function setSwitch(name, value, isKept = true) {
  try {
    viewer?.setSwitch(name, value);
    byId(name).value = value;
    if (isKept) storage.write(name, value);
  } catch (error) {
    console.warn(sentence(error));
  }
}

/** @param {"light" | "deform"} name */
function nextChoice(name) {
  const values = CHOICES[name].map(([value]) => value);
  setSwitch(name, values[(values.indexOf(byId(name).value) + 1) % values.length]);
}

/** Obeys a key. @param {string} key @returns {boolean} whether it meant anything */
function obey(key) {
  const wrinkles = byId("wrinkles").value;
  if (/^[1-6]$/.test(key)) chooseView(VIEWS[Number(key) - 1]);
  else if (key === "w") {
    if (wrinkles !== "off") wrinklesBefore = wrinkles;
    setSwitch("wrinkles", wrinkles === "off" ? wrinklesBefore : "off");
  } else if (key === "z") {
    const systems = ["own", "bones", "zones", "both"];
    setSwitch("wrinkles", systems[(systems.indexOf(wrinkles) + 1) % systems.length]);
  } else if (key === "b") {
    blend = (blend + 1) % BLENDS.length;
    try {
      viewer?.setSwitch("blend", BLENDS[blend]);
    } catch (error) {
      console.warn(sentence(error));
    }
  } else if (key === "l") nextChoice("light");
  else if (key === "d") nextChoice("deform");
  else if (key === "r") viewer?.resetCamera();
  else if (key === "h") panel.toggle();
  else if (key === "p") {
    if (panel.isOpen) panel.next();
    else panel.toggle(true);
  } else if (key === "f") toggleFullScreen();
  else if (key === "c") tellCamera({ type: "calibrate" });
  else if (key === "x") tellCamera({ type: "recentre" });
  else if (key === " " && takes?.isReplaying) takes.toggle();
  else if (key === "?") byId("help").showModal();
  else return false;
  return true;
}

async function toggleFullScreen() {
  try {
    if (document.fullscreenElement) await document.exitFullscreen();
    else await document.documentElement.requestFullscreen();
  } catch {
    // A browser that does not let pages fill the screen stays as it is.
  }
}

function listen() {
  addEventListener("keydown", (event) => {
    const target = /** @type {HTMLElement} */ (event.target);
    const isTyping = target.matches("select, textarea, input:not([type=range]):not([type=checkbox])");
    // A button takes the space bar for itself.
    if (event.key === " " && target.matches("button, summary, a, input")) return;
    if (isTyping || event.ctrlKey || event.metaKey || event.altKey || document.querySelector("dialog[open]")) return;
    if (obey(event.key.length === 1 ? event.key.toLowerCase() : event.key)) event.preventDefault();
  });
  addEventListener("popstate", () => enter(roomOfAddress(), false));
  byId("full-screen").addEventListener("click", toggleFullScreen);
  byId("full-screen").hidden = !document.fullscreenEnabled;
  byId("help-button").addEventListener("click", () => obey("?"));
  byId("reset-camera").addEventListener("click", () => viewer?.resetCamera());
  for (const [name, values] of Object.entries(CHOICES)) {
    byId(name).append(...values.map(([value, text]) => element("option", { value }, text)));
    byId(name).addEventListener("change", () => setSwitch(/** @type {any} */ (name), byId(name).value));
  }
  byId("keys").append(...KEYS.flatMap(([keys, what]) => [
    element("dt", {}, .../** @type {string[]} */ (keys).map((key) => (key === "–" ? "–" : element("kbd", {}, key)))),
    element("dd", {}, /** @type {string} */ (what)),
  ]));
  /** @type {HTMLDialogElement} */
  const help = byId("help");
  help.addEventListener("click", (event) => {
    if (event.target === help) help.close();
  });
  listenForCopies();
}

/**
 * Draws on a canvas.
 * @param {HTMLCanvasElement} canvas @param {FaceViewer | null} before the one whose view and switches it has
 */
async function openViewer(canvas, before) {
  const started = await FaceViewer.start(canvas, { backend: parameters.get("backend") ?? "auto", transparent: isTransparent });
  viewer = started;
  byId("backend").textContent = `Drawn with ${started.backend()}.`;
  document.documentElement.dataset.backend = started.backend();
  for (const name of /** @type {("wrinkles" | "light" | "deform")[]} */ (Object.keys(CHOICES))) setSwitch(name, byId(name).value, false);
  if (before) started.takeOver(before);
  showViews();
  new Stage(canvas, started, (now) => {
    const frame = inspector.isOpen ? started.frame() : null;
    if (!frame) return;
    const { latencyMs, drawMs } = started.stats();
    inspector.pictureShown(frame, latencyMs + drawMs, now);
  }, drawingFailed);
}

async function start() {
  document.body.classList.add("viewer");
  document.body.classList.toggle("bare", isBare);
  document.body.classList.toggle("transparent", isTransparent);
  document.documentElement.classList.toggle("transparent", isTransparent);
  listen();
  byId("room-name").textContent = room;
  document.title = `${room} · Rhytid`;
  picker.current = room;
  puppet.room = room;
  takes?.enter(room);
  for (const name of /** @type {("wrinkles" | "light" | "deform")[]} */ (Object.keys(CHOICES))) {
    const known = CHOICES[name].map(([value]) => value);
    // What the address says is for this page alone.
    byId(name).value = [parameters.get(name), storage.read(name)].find((value) => known.includes(value)) ?? known[0];
  }
  // Hello and character come while the viewer is loaded.
  openLink();
  try {
    await openViewer(byId("face"), null);
  } catch (error) {
    problem = sentence(error);
    showState();
    return;
  }
  chooseView(parameters.get("view") ?? "beauty");
  setInterval(showNumbers, NUMBERS);
  if (earlyHello) greeted(earlyHello);
  if (!isBare && storage.read("panel") !== false && innerWidth > 1100) panel.toggle(true);
}

byId("panel-button").addEventListener("click", () => storage.write("panel", panel.isOpen));
start();
