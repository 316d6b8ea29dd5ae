// How the server treats what a tracker sends: smoothing, gains, mirror. Changed while frames come.

import { element, fillTrack, storage } from "./util.js";

/** Groups of the smoothing; the server tells the delay of lids as that of eyelids. */
const SMOOTHING = [["brows", "Brows"], ["lids", "Lids"], ["mouth", "Mouth"], ["head", "Head"]];
const GAINS = [["brows", "Brows"], ["lids", "Lids"], ["gaze", "Gaze"], ["mouth", "Mouth"], ["head", "Head"]];
const FLAGS = [["mirror", "Mirror: my left moves the character's right"], ["swap_jaw", "Swap the jaw's left and right"], ["swap_mouth", "Swap the mouth's left and right"]];
/** Milliseconds after the last move of a knob before the server is told. */
const CALM = 80;

export class Settings {
  /**
   * @param {HTMLElement} place
   * @param {(values: Record<string, any>) => void} changed called once a hand has paused
   * @param {{key?: string, prefix?: string}} [how] key: where the browser keeps them, nowhere without; prefix: before the knobs' ids
   */
  constructor(place, changed, { key = "", prefix = "" } = {}) {
    this.place = place;
    this.changed = changed;
    this.key = key;
    this.prefix = prefix;
    this.timer = 0;
    /** @type {Record<string, any>} */
    this.values = { mirror: false, gains: {}, smoothing: {}, ...(key ? storage.read(key) : {}) };
    /** @type {Map<string, {input: HTMLInputElement, output: HTMLElement}>} */
    this.knobs = new Map();
    /** @type {Map<string, HTMLInputElement>} */
    this.flags = new Map();
    /** Seconds each group of the smoothing adds. @type {Record<string, number>} */
    this.delays = {};
    this.#build();
    this.show();
  }

  /** For the hello. */
  toJson() {
    return structuredClone(this.values);
  }

  #build() {
    this.note = element("p", { class: "note small-text", role: "status" });
    this.note.hidden = true;
    this.place.append(this.note,
      element("h2", {}, "Smoothing, and the delay it adds"),
      ...SMOOTHING.map(([name, text]) => this.#knob("smoothing", name, text, 4)),
      element("h2", {}, "Strength"),
      ...GAINS.map(([name, text]) => this.#knob("gains", name, text, 3)),
      ...FLAGS.map(([name, text]) => {
        const input = element("input", { type: "checkbox", onchange: () => this.set(name, input.checked) });
        this.flags.set(name, input);
        return element("label", { class: "check" }, input, text);
      }),
      element("div", { class: "actions" }, element("button", { class: "small", onclick: () => this.reset() }, "Back to the defaults")));
  }

  /** @param {"smoothing" | "gains"} kind @param {string} name @param {string} text @param {number} most */
  #knob(kind, name, text, most) {
    const id = `${this.prefix}knob-${kind}-${name}`;
    const input = element("input", { type: "range", min: "0", max: String(most), step: "0.05", id });
    const output = element("output", { for: id });
    input.addEventListener("input", () => {
      this.values[kind] = { ...this.values[kind], [name]: Number(input.value) };
      this.#tell();
    });
    this.knobs.set(`${kind}.${name}`, { input, output });
    return element("div", { class: "knob" }, element("label", { for: id }, text), input, output);
  }

  /** @param {string} name @param {any} value */
  set(name, value) {
    this.values[name] = value;
    this.#tell();
  }

  reset() {
    this.values = { mirror: false, swap_jaw: false, swap_mouth: false };
    for (const [kind, names] of [["smoothing", SMOOTHING], ["gains", GAINS]]) {
      this.values[/** @type {string} */ (kind)] = Object.fromEntries(/** @type {string[][]} */ (names).map(([name]) => [name, 1]));
    }
    this.#tell();
  }

  #tell() {
    this.show();
    this.#keep();
    clearTimeout(this.timer);
    this.timer = setTimeout(() => {
      this.timer = 0;
      this.changed(this.toJson());
    }, CALM);
  }

  /** What the server answered. @param {Record<string, number> | undefined} delays seconds by group */
  setDelays(delays) {
    if (!delays) return;
    this.delays = delays;
    this.show();
  }

  #keep() {
    if (this.key) storage.write(this.key, this.values);
  }

  /** @param {Record<string, any>} values settings that came with a profile, or are in use */
  take({ mirror, swap_jaw, swap_mouth, gains, smoothing }) {
    const given = { mirror, swap_jaw, swap_mouth, gains, smoothing };
    this.values = { ...this.values, ...Object.fromEntries(Object.entries(given).filter(([, value]) => value !== undefined)) };
    this.#keep();
    this.show();
  }

  /** A hand is at a knob, or the server has not been told yet. */
  isBusy() {
    return this.timer !== 0;
  }

  /** @param {string} text empty where all is well */
  say(text) {
    if (!this.note) return;
    this.note.textContent = text;
    this.note.hidden = !text;
  }

  show() {
    for (const [key, { input, output }] of this.knobs) {
      const [kind, name] = key.split(".");
      const value = Number(this.values[kind]?.[name] ?? 1);
      if (Number(input.value) !== value) input.value = String(value);
      fillTrack(input);
      const delay = this.delays[name] ?? this.delays[name === "lids" ? "eyelids" : name];
      const shown = kind === "smoothing" && value === 0 ? "raw" : `× ${value.toFixed(2)}`;
      output.textContent = kind === "smoothing" && Number.isFinite(delay) ? `${shown} · ${Math.round(1000 * delay)} ms` : shown;
      input.setAttribute("aria-valuetext", output.textContent);
    }
    for (const [name, input] of this.flags) input.checked = Boolean(this.values[name]);
  }
}
