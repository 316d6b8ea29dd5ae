// The puppeteer's panel: sliders, expressions and poses, published like a tracker's frames.

import { Clock } from "./clock.js";
import { PublishLink, publishSentence } from "./publish_link.js";
import { EXPRESSION_FACES, REGIONS, SHAPES, label, mirrored } from "./names.js";
import { PuppetFace } from "./puppet_face.js";
import { element, fillTrack, wallClock } from "./util.js";

/** Milliseconds between two frames while something moves: 30 a second with a margin for the timer. */
const MOVING = 33;
/** Milliseconds between two frames at rest: viewers ease a sender that is silent for 250 ms back to neutral. */
const RESTING = 100;
/** Frames at the full rate after the last move, so that viewers' clocks settle. */
const SETTLING = 15;

export class Puppet {
  /**
   * @param {HTMLElement} page
   * @param {(t: number, sentAt: number) => void} sent called for each frame that went out: its time, and when by the wall clock
   */
  constructor(page, sent) {
    this.page = page;
    this.sent = sent;
    this.face = new PuppetFace();
    this.isLinked = true;
    this.room = "demo";
    /** @type {PublishLink | null} */
    this.link = null;
    /** @type {Map<string, {input: HTMLInputElement, output: HTMLElement, row: HTMLElement}>} */
    this.rows = new Map();
    this.lastStep = 0;
    this.lastSent = 0;
    this.settling = 0;
    /** @type {Clock | null} */
    this.clock = null;
    this.#build();
  }

  #build() {
    this.sentence = element("p", { role: "status", "aria-live": "polite" }, "Move a slider to take the face.");
    this.toggle = element("button", { class: "small primary", onclick: () => (this.isOn() ? this.stop() : this.start(this.link?.state === "taken")) }, "Start");
    this.expressions = element("div", { class: "sliders" });
    this.poses = element("div", { class: "sliders" });
    const mirror = element("input", { type: "checkbox", checked: true, onchange: () => (this.isLinked = mirror.checked) });
    const regions = REGIONS.map(({ title, names }, i) =>
      element("details", { open: i === 0 }, element("summary", {}, title),
        element("div", { class: "sliders", role: "group", "aria-label": title }, ...names.map((name) => this.#slider(`shape:${name}`, label(name))))));
    this.page.append(
      element("div", { class: "publish" }, this.sentence, this.toggle),
      element("div", { class: "row" },
        element("button", { class: "small", onclick: () => this.reset() }, "Reset"),
        element("button", { class: "small", onclick: () => this.random() }, "Random"),
        element("label", { class: "check" }, mirror, "Both sides together")),
      element("h2", {}, "Expressions"), this.expressions,
      element("h2", {}, "Reference poses"), this.poses,
      element("h2", {}, "Shapes"), ...regions);
    this.setExpressions(Object.keys(EXPRESSION_FACES));
    this.#show();
  }

  /** @param {string[]} names */
  setExpressions(names) {
    for (const key of [...this.rows.keys()]) if (key.startsWith("expression:")) this.rows.delete(key);
    const rows = names.map((name) => this.#slider(`expression:${name}`, name.charAt(0).toUpperCase() + name.slice(1)));
    this.expressions?.replaceChildren(...(rows.length ? rows : [element("p", { class: "quiet" }, "This character knows none.")]));
  }

  /** @param {any} character the view hello's */
  setCharacter(character) {
    this.face.setCharacter(character);
    const names = character.poses.map((/** @type {any} */ pose) => pose.name);
    if (names.join() === this.poseNames) return;
    this.poseNames = names.join();
    for (const key of [...this.rows.keys()]) if (key.startsWith("pose:")) this.rows.delete(key);
    const rows = names.map((/** @type {string} */ name) => this.#slider(`pose:${name}`, name.charAt(0).toUpperCase() + name.slice(1)));
    this.poses?.replaceChildren(...(rows.length ? rows : [element("p", { class: "quiet" }, "This character has none.")]));
  }

  /** @param {string} key @param {string} text */
  #slider(key, text) {
    const id = `slider-${key.replace(":", "-")}`;
    const output = element("output", { for: id }, "0");
    const input = element("input", { type: "range", min: "0", max: "1", step: "0.01", value: "0", id });
    input.addEventListener("input", () => this.#moved(key, Number(input.value)));
    const row = element("div", { class: "slider" }, element("label", { for: id, title: text }, text), input, output);
    this.rows.set(key, { input, output, row });
    return row;
  }

  /** @param {string} key @param {number} value */
  #moved(key, value) {
    this.face.set(key, value);
    if (this.isLinked && key.startsWith("shape:")) {
      const other = `shape:${mirrored(key.slice("shape:".length))}`;
      if (other !== key) this.face.set(other, value);
    }
    this.#show();
    this.#wake();
  }

  #show() {
    for (const [key, { input, output, row }] of this.rows) {
      const value = this.face.targets.get(key) ?? 0;
      if (Number(input.value) !== value) input.value = String(value);
      fillTrack(input);
      output.textContent = String(Math.round(100 * value));
      row.classList.toggle("active", value > 0);
    }
  }

  reset() {
    this.face.reset();
    this.#show();
    this.#wake();
  }

  /** A face that could be one: a few shapes, both sides nearly alike. */
  random() {
    this.face.reset();
    const stems = [...new Set(SHAPES.map((name) => name.replace(/(Left|Right)$/, "")))];
    for (let i = 0; i < 6; i += 1) {
      const stem = stems[Math.floor(Math.random() * stems.length)];
      const value = 0.25 + 0.6 * Math.random();
      for (const name of SHAPES.filter((shape) => shape === stem || shape === `${stem}Left` || shape === `${stem}Right`)) {
        this.face.set(`shape:${name}`, value * (0.85 + 0.15 * Math.random()));
      }
    }
    this.#show();
    this.#wake();
  }

  /** A hand on a slider takes the face, unless somebody has it. */
  #wake() {
    this.settling = SETTLING;
    if (!this.link || this.link.state === "off") this.start(false);
  }

  isOn() {
    return Boolean(this.link) && !["off", "taken", "refused"].includes(/** @type {PublishLink} */ (this.link).state);
  }

  /** @param {boolean} takeover */
  start(takeover) {
    this.link?.stop();
    const hello = () => ({ source: "puppeteer", fps: 30, slot: "puppet", priority: 60 });
    this.link = new PublishLink(this.room, hello, { state: (state, detail) => this.#became(state, detail) });
    this.link.start({ takeover });
    this.lastStep = performance.now();
    this.clock ??= new Clock(1000 / 60, () => this.#tick());
  }

  stop() {
    this.clock?.stop();
    this.clock = null;
    this.link?.stop();
    this.link = null;
  }

  /** @param {string} room */
  enter(room) {
    const wasOn = this.isOn();
    this.stop();
    this.room = room;
    if (wasOn) this.start(false);
  }

  /** @param {import("./publish_link.js").PublishState} state @param {string} detail */
  #became(state, detail) {
    const { sentence, toggle } = this;
    if (!sentence || !toggle) return;
    if (state === "off") sentence.textContent = "Move a slider to take the face.";
    else if (state === "ready") sentence.textContent = `You move the face of room ${this.room}. Stop lets it go.`;
    else sentence.textContent = publishSentence(state, this.room, detail);
    toggle.textContent = state === "taken" ? "Take over" : this.isOn() ? "Stop" : "Start";
    toggle.classList.toggle("primary", !this.isOn());
    this.settling = SETTLING;
  }

  #tick() {
    const now = performance.now();
    const hasMoved = this.face.step(Math.min(0.1, (now - this.lastStep) / 1000));
    this.lastStep = now;
    if (hasMoved) this.settling = SETTLING;
    const interval = this.settling > 0 ? MOVING : RESTING;
    // A timer that is a little early must not cost a whole turn.
    if (now - this.lastSent < interval - 4) return;
    this.lastSent = now;
    this.settling = Math.max(0, this.settling - 1);
    const t = Math.round(now * 1000) / 1e6;
    if (this.link?.sendFrame(this.face.frame(t))) this.sent(t, wallClock());
  }
}
