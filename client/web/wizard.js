// The guided fit: eight faces in about twenty seconds, measured by the server, kept as a profile.

import { byId, element } from "./util.js";

/** @type {{step: string, title: string, text: string}[]} */
const STEPS = [
  { step: "neutral", title: "Face at rest", text: "Look straight into the camera and do nothing." },
  { step: "brows_up", title: "Brows up", text: "As if surprised, as high as they go." },
  { step: "frown", title: "Frown", text: "Brows down and together." },
  { step: "smile", title: "Smile", text: "Broadly, lips closed or not." },
  { step: "pucker", title: "Pucker", text: "As for a kiss." },
  { step: "jaw_open", title: "Mouth wide open", text: "Let the jaw drop." },
  { step: "blink", title: "Close your eyes", text: "Open them when you hear the tone." },
  { step: "mouth_left", title: "Mouth to your left", text: "Pull it to your own left, jaw and lips." },
];
/** Seconds to get into a face, and seconds it is measured. */
const READY = 1;
const HOLD = 1.5;
/** How much longer than it measures the server may take to answer, milliseconds. */
const PATIENCE = 4000;

const OFFERS = {
  mirror: "Your mouth went to the other side than asked: mirror the picture",
  swap_jaw: "Your jaw went to the other side than asked: swap its left and right",
  swap_mouth: "Your mouth went to the other side than asked: swap its left and right",
};

export class Wizard {
  /**
   * @param {object} host
   * @param {(message: any, matches: (answer: any) => boolean, patience: number) => Promise<any>} host.ask
   * @param {(profile: any) => void} host.done takes the new profile
   * @param {(offers: Record<string, boolean>) => void} host.apply takes the settings the person agreed to
   * @param {(profile: any) => void} host.save gives the profile as a file
   * @param {(isOpen: boolean) => void} host.opened
   */
  constructor(host) {
    this.host = host;
    /** @type {HTMLDialogElement} */
    this.dialog = byId("wizard");
    this.run = 0;
    this.isOpen = false;
    this.isRunning = false;
    /** @type {AudioContext | undefined} */
    this.sound = undefined;
    this.dialog.addEventListener("cancel", (event) => {
      event.preventDefault();
      this.cancel();
    });
  }

  /** The canvas for the person's own picture. */
  self() {
    return byId("wizard-self");
  }

  open() {
    this.isOpen = true;
    this.host.opened(true);
    this.#bars(-1, []);
    byId("wizard-count").textContent = "";
    byId("wizard-title").textContent = "Fit to my face";
    byId("wizard-text").replaceChildren(element("p", {}, "Eight faces, twenty seconds. Make each as strongly as you can and hold it until the bar is full."));
    this.#buttons(["Start", () => this.go(), true], ["Cancel", () => this.cancel()]);
    this.dialog.showModal();
  }

  close() {
    this.run += 1;
    this.isOpen = false;
    this.dialog.close();
    this.host.opened(false);
  }

  cancel() {
    if (this.isRunning) this.host.ask({ type: "fit", step: "cancel" }, (answer) => answer.type === "fit" || answer.type === "error", 500).catch(() => {});
    this.isRunning = false;
    this.close();
  }

  async go() {
    this.run += 1;
    const run = this.run;
    const isOver = () => run !== this.run;
    this.isRunning = true;
    /** @type {("done" | "skipped")[]} */
    const results = [];
    /** @type {string[]} */
    const notes = [];
    this.sound ??= new AudioContext();
    for (let i = 0; i < STEPS.length; i += 1) {
      const { step, title, text } = STEPS[i];
      byId("wizard-title").textContent = title;
      byId("wizard-text").replaceChildren(element("p", {}, text));
      this.#bars(i, results);
      this.#buttons(["Cancel", () => this.cancel()]);
      await this.#count(READY, () => {}, isOver);
      if (isOver()) return;
      const bar = /** @type {HTMLElement | null} */ (byId("wizard-steps").children[i]?.firstElementChild);
      const answer = this.host.ask({ type: "fit", step, seconds: HOLD },
        (message) => (message.type === "fit" && message.step === step && message.done) || message.type === "error", 1000 * HOLD + PATIENCE);
      // Watched from the start: a refusal must not wait for the bar.
      const settled = answer.then((value) => ({ value, error: null }), (error) => ({ value: null, error }));
      await this.#count(HOLD, (share) => bar && (bar.style.width = `${100 * share}%`), isOver);
      this.#tone();
      const { value, error } = await settled;
      if (isOver()) return;
      if (error) {
        const next = await this.#problem(error, step === "neutral");
        if (isOver() || next === "cancel") return;
        if (next === "again") {
          i -= 1;
          continue;
        }
        results.push("skipped");
        notes.push(`${title}: left out.`);
      } else {
        results.push("done");
        if (value.note) notes.push(`${title}: ${value.note}`);
      }
    }
    this.#bars(STEPS.length, results);
    try {
      const { profile, warnings = [], offers = {} } = await this.host.ask({ type: "fit", step: "finish" }, (message) => message.type === "profile" || message.type === "error", PATIENCE);
      if (isOver()) return;
      this.isRunning = false;
      this.host.done(profile);
      this.#finished(profile, [...warnings, ...notes], offers);
    } catch (error) {
      if (isOver()) return;
      this.#stopped(/** @type {Error} */ (error).message);
    }
  }

  /** @param {Error & {code?: string}} error @param {boolean} isNeeded @returns {Promise<"again" | "skip" | "cancel">} */
  #problem(error, isNeeded) {
    byId("wizard-count").textContent = "";
    if (error.code === "unknown_type") {
      this.#stopped("This server cannot fit a performer: it is an older one.");
      return Promise.resolve("cancel");
    }
    byId("wizard-title").textContent = "Once more?";
    byId("wizard-text").replaceChildren(element("p", { role: "alert" }, `${error.message.charAt(0).toUpperCase()}${error.message.slice(1)}.`.replace("..", ".")));
    return new Promise((resolve) => {
      /** @type {any[]} */
      const buttons = [["Again", () => resolve("again"), true]];
      if (!isNeeded) buttons.push(["Leave it out", () => resolve("skip")]);
      buttons.push(["Cancel", () => {
        this.cancel();
        resolve("cancel");
      }]);
      this.#buttons(...buttons);
    });
  }

  /** @param {string} why */
  #stopped(why) {
    this.isRunning = false;
    byId("wizard-count").textContent = "";
    byId("wizard-title").textContent = "That did not work";
    byId("wizard-text").replaceChildren(element("p", { role: "alert" }, why));
    this.#buttons(["Again", () => this.go(), true], ["Close", () => this.close()]);
  }

  /** @param {any} profile @param {string[]} remarks @param {Record<string, boolean>} offers */
  #finished(profile, remarks, offers) {
    byId("wizard-count").textContent = "";
    byId("wizard-title").textContent = "Done";
    /** @type {Map<string, HTMLInputElement>} */
    const boxes = new Map();
    const offered = Object.entries(offers).filter(([name]) => name in OFFERS).map(([name]) => {
      const box = element("input", { type: "checkbox", checked: true });
      boxes.set(name, box);
      return element("label", { class: "check" }, box, OFFERS[/** @type {keyof typeof OFFERS} */ (name)] ?? name);
    });
    byId("wizard-text").replaceChildren(
      element("p", {}, "The profile is in use and kept in this browser."),
      ...(remarks.length ? [element("ul", { class: "wizard-list" }, ...remarks.map((remark) => element("li", {}, remark)))] : []),
      ...offered);
    this.#buttons(
      ["Use it", () => {
        const agreed = [...boxes].filter(([, box]) => box.checked).map(([name]) => [name, offers[name]]);
        if (agreed.length) this.host.apply(Object.fromEntries(agreed));
        this.close();
      }, true],
      ["Save as a file", () => this.host.save(profile)],
      ["Again", () => this.go()]);
  }

  /**
   * @param {number} seconds @param {(share: number) => void} shown @param {() => boolean} isOver
   * @returns {Promise<void>}
   */
  #count(seconds, shown, isOver) {
    const start = performance.now();
    return new Promise((resolve) => {
      const timer = setInterval(() => {
        const passed = (performance.now() - start) / 1000;
        shown(Math.min(1, passed / seconds));
        byId("wizard-count").textContent = passed < seconds ? String(Math.ceil(seconds - passed)) : "";
        if (passed >= seconds || isOver()) {
          clearInterval(timer);
          resolve();
        }
      }, 40);
    });
  }

  /** @param {number} now @param {("done" | "skipped")[]} results */
  #bars(now, results) {
    const bars = byId("wizard-steps");
    bars.replaceChildren(...STEPS.map((_, i) => element("i", { class: results[i] ?? (i === now ? "now" : "") }, element("b", {}))));
    bars.setAttribute("aria-valuemax", String(STEPS.length));
    bars.setAttribute("aria-valuenow", String(results.length));
  }

  /** @param {...any[]} buttons text, what it does, whether it is the main one */
  #buttons(...buttons) {
    byId("wizard-buttons").replaceChildren(...buttons.map(([text, act, isMain]) => element("button", { class: isMain ? "primary" : "", onclick: act }, text)));
    /** @type {HTMLElement | null} */ (byId("wizard-buttons").querySelector("button"))?.focus();
  }

  #tone() {
    const sound = this.sound;
    if (!sound) return;
    const [pitch, loudness] = [sound.createOscillator(), sound.createGain()];
    pitch.frequency.value = 660;
    loudness.gain.setValueAtTime(0.08, sound.currentTime);
    loudness.gain.exponentialRampToValueAtTime(0.001, sound.currentTime + 0.18);
    pitch.connect(loudness).connect(sound.destination);
    pitch.start();
    pitch.stop(sound.currentTime + 0.2);
  }
}
