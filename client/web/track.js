// The camera page: tracks a face in the browser and publishes its points to a room.

import { listCameras, openCamera } from "./camera.js";
import { Clock } from "./clock.js";
import { drawPoints, keyHeights } from "./overlay.js";
import { readProfile, saveProfile } from "./profiles.js";
import { PublishLink, publishSentence } from "./publish_link.js";
import { answerOf } from "./questions.js";
import { Settings } from "./settings.js";
import { FaceTracker } from "./tracker.js";
import { byId, roomOfAddress, storage, wallClock } from "./util.js";
import { encodePoints } from "./wire.js";
import { Wizard } from "./wizard.js";

const NUM_POINTS = 478;
/** Milliseconds between two frames that say nobody is in view. */
const NOBODY = 100;
/** Milliseconds between two looks at the video while the page is out of sight. */
const HIDDEN = 30;
/** Milliseconds without a presented picture after which the page is taken to be out of sight: in a frame that is not shown it is not told. */
const UNSEEN = 150;

const isEmbedded = new URLSearchParams(location.search).get("embedded") === "1" && parent !== window;
/** @type {HTMLVideoElement} */
const video = byId("video");
/** @type {HTMLCanvasElement} */
const overlay = byId("overlay");
const points = new Float32Array(3 * NUM_POINTS);

let room = roomOfAddress();
/** @type {FaceTracker | null} */
let tracker = null;
/** @type {MediaStream | null} */
let stream = null;
/** Counts starts: what belongs to an older one ends itself. */
let run = 0;
let lastT = 0;
let lastNobody = 0;
/** @type {Clock | null} */
let clock = null;
let lastVideoTime = -1;
/** When the last picture had been tracked, and how long that took, milliseconds. */
let tracked = { at: 0, took: 0 };
/** Keeps a phone's screen on. @type {WakeLockSentinel | null} */
let wakeLock = null;
let isMirrored = true;
/** @type {any} */
let profile = storage.read("profile");
/** Pictures tracked since the last look, and when that was. */
let rate = { frames: 0, since: performance.now() };

let link = newLink();
const settings = new Settings(byId("settings-body"), (values) => tellSettings(values), { key: "settings" });
const wizard = new Wizard({
  ask: (message, matches, patience) => link.ask(message, matches, patience),
  done: ({ profile: made, kept }) => {
    keepProfile(made);
    return kept ? `The profile is in use, kept in this browser, and by the server as “${made.name}”.` : "The profile is in use and kept in this browser.";
  },
  apply: (offers) => {
    for (const [name, isOn] of Object.entries(offers)) settings.set(name, isOn);
  },
  save: (made) => saveProfile(made),
  opened: (isOpen) => tellParent({ type: "expand", isOn: isOpen }),
}, true);

function newLink() {
  return new PublishLink(room, hello, { state: (state, detail) => publishState(state, detail), message: (message) => heard(message) });
}

function hello() {
  return {
    source: "webcam",
    fps: 30,
    layout: "mediapipe478",
    image: [video.videoWidth, video.videoHeight],
    settings: settings.toJson(),
    ...(profile ? { profile } : {}),
  };
}

/** @param {Record<string, any>} message */
function tellParent(message) {
  if (isEmbedded) parent.postMessage({ from: "rhytid", ...message }, location.origin);
}

/** @param {string} text empty where all is well */
function sayProblem(text) {
  byId("problem").textContent = text;
  byId("problem").hidden = !text;
}

// The camera.

/** @param {string} [deviceId] */
async function start(deviceId = storage.read("camera") ?? "") {
  stop();
  run += 1;
  const mine = run;
  sayProblem("");
  const button = byId("start");
  button.disabled = true;
  button.textContent = "Starting…";
  try {
    const opened = await openCamera(deviceId);
    if (mine !== run) {
      end(opened);
      return;
    }
    stream = opened;
    for (const track of opened.getVideoTracks()) {
      track.addEventListener("ended", () => {
        if (mine !== run) return;
        stop();
        sayProblem("The camera went away. Plug it in again or choose another one, then start again.");
      });
    }
    video.srcObject = opened;
    await video.play();
    byId("self").style.aspectRatio = `${video.videoWidth} / ${video.videoHeight}`;
    button.textContent = "Loading the tracker…";
    tracker ??= await FaceTracker.load();
    if (mine !== run) return;
    byId("idle").hidden = true;
    byId("controls").hidden = false;
    byId("publishing").hidden = false;
    byId("seen").hidden = false;
    byId("rate").hidden = false;
    showSeen(null);
    await showCameras();
    link.start();
    rate = { frames: 0, since: performance.now() };
    clock = new Clock(HIDDEN, () => tick());
    keepAwake();
    loop(mine);
  } catch (error) {
    if (mine === run) {
      stop();
      sayProblem(error instanceof Error ? error.message : String(error));
    }
  }
}

function stop() {
  run += 1;
  link.stop();
  clock?.stop();
  clock = null;
  wakeLock?.release().catch(() => {});
  wakeLock = null;
  if (stream) end(stream);
  stream = null;
  video.srcObject = null;
  drawPoints(overlay, null, overlay.width, overlay.height);
  for (const id of ["controls", "publishing", "seen", "rate"]) byId(id).hidden = true;
  byId("idle").hidden = false;
  byId("start").disabled = false;
  byId("start").textContent = "Start the camera";
}

/** @param {MediaStream} opened */
function end(opened) {
  for (const track of opened.getTracks()) track.stop();
}

async function showCameras() {
  const cameras = await listCameras();
  const current = stream?.getVideoTracks()[0]?.getSettings().deviceId;
  byId("cameras").replaceChildren(...cameras.map(({ id, name }) => new Option(name, id, false, id === current)));
  byId("cameras").hidden = cameras.length < 2;
}

// Frames.

/** @param {number} mine */
async function loop(mine) {
  while (mine === run) {
    const captured = await nextPicture();
    if (mine !== run) return;
    let isSeen = false;
    const begun = performance.now();
    try {
      isSeen = await /** @type {FaceTracker} */ (tracker).find(video, points);
    } catch (error) {
      if (mine !== run) return;
      stop();
      sayProblem(`The face tracker failed: ${error instanceof Error ? error.message : error}. Start again.`);
      return;
    }
    if (mine !== run) return;
    drawPoints(overlay, isSeen ? points : null, video.videoWidth, video.videoHeight);
    tracked = { at: performance.now(), took: performance.now() - begun };
    if (wizard.isOpen) drawSelf();
    showSeen(isSeen);
    publish(isSeen, captured);
    countRate();
  }
}

/**
 * Waits for the video's next picture.
 * @returns {Promise<number>} when it was captured, milliseconds of this page's clock
 */
function nextPicture() {
  return new Promise((resolve) => {
    const asked = performance.now();
    const request = video.requestVideoFrameCallback((now, { captureTime }) => {
      tick = () => {};
      lastVideoTime = video.currentTime;
      resolve(Math.min(now, captureTime ?? now));
    });
    // Out of sight no picture is presented, but the video goes on.
    tick = () => {
      if ((!document.hidden && performance.now() - asked < UNSEEN) || video.currentTime === lastVideoTime) return;
      // Where tracking is slow, the page's other work needs its share.
      if (performance.now() - tracked.at < 0.3 * tracked.took) return;
      tick = () => {};
      lastVideoTime = video.currentTime;
      video.cancelVideoFrameCallback(request);
      resolve(performance.now());
    };
  });
}

let tick = () => {};

async function keepAwake() {
  try {
    wakeLock = await navigator.wakeLock.request("screen");
  } catch {
    // Not every browser has it, and none grants it on an empty battery.
  }
}

/** @param {boolean} isSeen @param {number} captured */
function publish(isSeen, captured) {
  // Whole microseconds, as packets carry them, and always later than the frame before.
  const t = Math.max(Math.round(captured * 1000) / 1e6, lastT + 1e-3);
  if (!isSeen) {
    const now = performance.now();
    if (now - lastNobody < NOBODY) return;
    lastNobody = now;
    if (link.sendFrame({ type: "frame", t, face: false })) lastT = t;
    return;
  }
  if (!link.sendFrame(encodePoints(points, t))) return;
  lastT = t;
  tellParent({ type: "sent", t, captured: performance.timeOrigin + captured, sent: wallClock(), points: keyHeights(points) });
}

function drawSelf() {
  const canvas = wizard.self();
  const width = 360;
  const height = Math.round((width * video.videoHeight) / video.videoWidth) || 270;
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  context.save();
  if (isMirrored) {
    context.translate(width, 0);
    context.scale(-1, 1);
  }
  context.drawImage(video, 0, 0, width, height);
  context.drawImage(overlay, 0, 0, width, height);
  context.restore();
}

let shownSeen = "";

/** @param {boolean | null} isSeen null while nothing is known */
function showSeen(isSeen) {
  const text = isSeen === null ? "Looking for a face…" : isSeen ? "Face seen" : "No face in the picture";
  if (text === shownSeen) return;
  shownSeen = text;
  byId("seen").dataset.kind = isSeen ? "live" : "warn";
  byId("seen-text").textContent = text;
}

function countRate() {
  rate.frames += 1;
  const now = performance.now();
  if (now - rate.since < 1000) return;
  byId("rate").textContent = `${((1000 * rate.frames) / (now - rate.since)).toFixed(0)} fps`;
  rate = { frames: 0, since: now };
}

// The room.

/** @param {import("./publish_link.js").PublishState} state @param {string} detail */
function publishState(state, detail) {
  byId("publish-text").textContent = publishSentence(state, room, detail);
  byId("takeover").hidden = state !== "taken" && state !== "refused";
  byId("takeover").textContent = state === "refused" ? "Try again" : "Take over";
  for (const id of ["calibrate", "recentre", "wizard-open"]) byId(id).disabled = state !== "ready";
}

/** @param {any} message */
function heard(message) {
  if (message.added_delay) settings.setDelays(message.added_delay);
  if (message.type === "calibrated" && message.requested) byId("answer").textContent = "Calibrated: this face is at rest now.";
  if (message.type === "recentred") byId("answer").textContent = "This is straight ahead now.";
}

/** @param {Record<string, any>} values */
async function tellSettings(values) {
  if (link.state !== "ready") return;
  try {
    await link.ask({ type: "settings", ...values }, answerOf("settings"));
    settings.say("");
  } catch (error) {
    settings.say(`The server did not take them: ${/** @type {Error} */ (error).message}.`);
  }
}

function calibrate() {
  byId("answer").textContent = link.send({ type: "calibrate" }) ? "Calibrating: hold your face at rest…" : "Start the camera first.";
}

async function recentre() {
  try {
    await link.ask({ type: "recentre" }, answerOf("recentred"));
  } catch (error) {
    byId("answer").textContent = `Not re-centred: ${/** @type {Error} */ (error).message}.`;
  }
}

// The profile.

/** @param {any} made null forgets */
function keepProfile(made) {
  profile = made;
  storage.write("profile", made);
  if (made?.settings) settings.take(made.settings);
  showProfile();
}

function showProfile() {
  byId("profile-text").textContent = profile
    ? `In use: ${profile.name || "a profile of this browser"}.`
    : "None yet: “Fit to my face” makes one.";
  byId("profile-save").disabled = !profile;
  byId("profile-forget").disabled = !profile;
}

/** @param {File} file */
async function loadProfile(file) {
  try {
    const loaded = await readProfile(file);
    if (link.state === "ready") await link.ask({ type: "profile", profile: loaded }, answerOf("profile"));
    keepProfile(loaded);
  } catch (error) {
    byId("profile-text").textContent = `Not loaded: ${/** @type {Error} */ (error).message}.`;
  }
}

/** @param {string} name */
function enter(name) {
  if (name === room) return;
  const wasOn = link.state !== "off";
  link.stop();
  room = name;
  link = newLink();
  showRoom();
  if (wasOn) link.start();
}

function showRoom() {
  byId("room-name").textContent = room;
  byId("watch").href = `/?room=${room}`;
  document.title = `Camera of ${room} · Rhytid`;
}

function listen() {
  byId("start").addEventListener("click", () => start());
  byId("stop").addEventListener("click", () => stop());
  byId("calibrate").addEventListener("click", calibrate);
  byId("recentre").addEventListener("click", recentre);
  byId("wizard-open").addEventListener("click", () => wizard.open());
  byId("takeover").addEventListener("click", () => link.start({ takeover: link.state === "taken" }));
  byId("cameras").addEventListener("change", () => {
    storage.write("camera", byId("cameras").value);
    start(byId("cameras").value);
  });
  byId("mirror-self").addEventListener("change", () => {
    isMirrored = byId("mirror-self").checked;
    byId("self").classList.toggle("mirrored", isMirrored);
  });
  byId("profile-load").addEventListener("click", () => byId("profile-file").click());
  byId("profile-file").addEventListener("change", () => {
    const file = byId("profile-file").files?.[0];
    if (file) loadProfile(file);
    byId("profile-file").value = "";
  });
  byId("profile-save").addEventListener("click", () => saveProfile(profile));
  byId("profile-forget").addEventListener("click", () => keepProfile(null));
  // A phone that is turned has a picture of another size: the server must know.
  video.addEventListener("resize", () => {
    if (link.state === "ready") link.start();
  });
  // The screen's lock is lost whenever the page is out of sight.
  document.addEventListener("visibilitychange", () => {
    if (!document.hidden && stream) keepAwake();
  });
  navigator.mediaDevices?.addEventListener?.("devicechange", () => {
    if (stream) showCameras();
  });
  addEventListener("keydown", (event) => {
    const target = /** @type {HTMLElement} */ (event.target);
    if (event.ctrlKey || event.metaKey || event.altKey || target.matches("select, input:not([type=range]):not([type=checkbox])") || wizard.isOpen) return;
    const key = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    if (key === "c") calibrate();
    else if (key === "x") recentre();
    else if (isEmbedded && key.length === 1 && key !== " ") tellParent({ type: "key", key });
  });
  addEventListener("message", ({ origin, data, source }) => {
    if (!isEmbedded || origin !== location.origin || source !== parent || data?.from !== "rhytid") return;
    if (data.type === "calibrate") calibrate();
    else if (data.type === "recentre") recentre();
    else if (data.type === "room") enter(String(data.room));
  });
}

document.body.classList.toggle("embedded", isEmbedded);
listen();
showRoom();
showProfile();
