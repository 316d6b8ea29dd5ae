// The guided fit: eight faces in about twenty seconds, measured by the server, kept as a profile.

import { answerOf, isRefusal } from "./questions.js";
import { ROOM_NAME, byId, element } from "./util.js";

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
   * @param {(answer: any) => string} host.done takes the answer with the new profile; gives a sentence on where it is kept
   * @param {(offers: Record<string, boolean>) => void} host.apply takes the settings the person agreed to
   * @param {(profile: any) => void} host.save gives the profile as a file
   * @param {(isOpen: boolean) => void} host.opened
   * @param {boolean} hasPicture whether the person's own picture is shown
   */
  constructor(host, hasPicture) {
    this.host = host;
    this.dialog = dialog(hasPicture);
    this.name = "";
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

  /** @param {string} [whom] who is fitted, in words */
  open(whom = "") {
    this.isOpen = true;
    this.host.opened(true);
    this.#bars(-1, []);
    byId("wizard-count").textContent = "";
    byId("wizard-title").textContent = whom ? "Fit the performer" : "Fit to my face";
    const name = element("input", { id: "wizard-name", maxLength: 64, autocomplete: "off", spellcheck: false, value: this.name, placeholder: "none", "aria-describedby": "wizard-wrong" });
    const wrong = element("p", { id: "wizard-wrong", class: "note", role: "alert" });
    byId("wizard-text").replaceChildren(
      element("p", {}, "Eight faces, twenty seconds. Make each as strongly as you can and hold it until the bar is full."),
      ...(whom ? [element("p", { class: "quiet" }, `The person in front of ${whom} must see this page.`)] : []),
      element("p", { class: "wizard-field" }, element("label", { for: "wizard-name" }, "The profile’s name"), name), wrong);
    const start = () => {
      const text = name.value.trim();
      if (text && !ROOM_NAME.test(text)) {
        wrong.textContent = "A name has letters, digits, “_” or “-”, no spaces.";
        name.focus();
        return;
      }
      this.name = text;
      this.go();
    };
    this.#buttons(["Start", start, true], ["Cancel", () => this.cancel()]);
    this.dialog.showModal();
    this.#focus();
  }

  close() {
    this.run += 1;
    this.isOpen = false;
    this.dialog.close();
    this.host.opened(false);
  }

  cancel() {
    if (this.isRunning) this.host.ask({ type: "fit", step: "cancel" }, answerOf("fit"), 500).catch(() => {});
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
        (message) => (message.type === "fit" && message.step === step && message.done) || isRefusal(message), 1000 * HOLD + PATIENCE);
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
      const finish = { type: "fit", step: "finish", ...(this.name ? { name: this.name } : {}) };
      const answer = await this.host.ask(finish, answerOf("profile"), PATIENCE);
      if (isOver()) return;
      this.isRunning = false;
      this.#finished(answer, this.host.done(answer), notes);
    } catch (error) {
      if (isOver()) return;
      this.#stopped(/** @type {Error} */ (error).message);
    }
  }

  /** @param {Error & {code?: string}} error @param {boolean} isNeeded @returns {Promise<"again" | "skip" | "cancel">} */
  #problem(error, isNeeded) {
    byId("wizard-count").textContent = "";
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

  /** @param {any} answer @param {string} kept where the profile is @param {string[]} notes on the steps */
  #finished({ profile, warnings = [], offers = {} }, kept, notes) {
    const remarks = [...warnings, ...notes];
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
      element("p", {}, kept),
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
    byId("wizard-buttons").replaceChildren(...buttons.map(([text, act, isMain]) => element("button", { type: "button", class: isMain ? "primary" : "", onclick: act }, text)));
    this.#focus();
  }

  #focus() {
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

/**
 * The dialog that covers the page.
 * @param {boolean} hasPicture
 * @returns {HTMLDialogElement}
 */
function dialog(hasPicture) {
  const picture = element("div", { class: "wizard-self" }, element("canvas", { id: "wizard-self", "aria-hidden": "true" }));
  picture.hidden = !hasPicture;
  const made = element("dialog", { id: "wizard", "aria-labelledby": "wizard-title" },
    element("div", { class: "wizard-steps", id: "wizard-steps", role: "progressbar", "aria-label": "Steps done", "aria-valuemin": "0" }),
    element("div", { class: "wizard-middle" },
      picture,
      element("h2", { id: "wizard-title", "aria-live": "assertive" }),
      element("div", { id: "wizard-text" }),
      element("div", { class: "wizard-count", id: "wizard-count", "aria-hidden": "true" })),
    element("div", { class: "wizard-buttons", id: "wizard-buttons" }));
  document.body.append(made);
  return made;
}
