// Recordings: the buttons that make one, the list of those there are, and the play bar of a room that plays one.

import { headers, onToken } from "./access.js";
import { byId, element, fillTrack } from "./util.js";

/** Milliseconds between two looks at the server: while something plays or is recorded, and while nothing is. */
const BUSY = 1000;
const QUIET = 4000;
/** Least milliseconds between two places that are asked for while the slider is dragged. */
const SCRUB = 80;
/** Milliseconds between two moves of the slider. */
const STEP = 100;
const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];

/** Minutes and seconds with tenths. @param {number} seconds */
export function clockText(seconds) {
  const tenths = Math.max(0, Math.round(seconds * 10));
  const [minutes, rest] = [Math.floor(tenths / 600), tenths % 600];
  return `${minutes}:${String(Math.floor(rest / 10)).padStart(2, "0")}.${rest % 10}`;
}

/** @param {number} bytes */
export function sizeText(bytes) {
  if (bytes < 1e6) return `${Math.max(1, Math.round(bytes / 1e3))} kB`;
  return bytes < 1e9 ? `${(bytes / 1e6).toFixed(1)} MB` : `${(bytes / 1e9).toFixed(2)} GB`;
}

/**
 * Where a player stands by now: it goes on between two looks at it.
 * @param {any} replay as the server says it @param {number} elapsed seconds since it said so
 */
export function placeNow(replay, elapsed) {
  const moved = replay.playing && Number.isFinite(replay.speed) ? replay.position + elapsed * replay.speed : replay.position;
  if (moved <= replay.to || !replay.loop || replay.to <= replay.from) return Math.min(moved, replay.to);
  return replay.from + ((moved - replay.from) % (replay.to - replay.from));
}

/** @typedef {{ wasPlaying: boolean, wanted: number | null, sending: Promise<any> | null }} Drag */

export class Takes {
  constructor() {
    this.room = "";
    this.isOpen = false;
    /** @type {any} what the server said last of the player */
    this.replay = null;
    /** @type {any} and of the recording */
    this.recording = null;
    this.isEnabled = false;
    /** Whether this page's token lets it record and play here. */
    this.mayControl = true;
    /** Whether this page's token does not even let it look. */
    this.isRefused = false;
    /** Whether it sees this room's recordings only. */
    this.isForRoom = false;
    this.saidAt = 0;
    this.timer = 0;
    this.listed = "";
    /** Counts the rooms, so that answers about one that was left are let go. */
    this.visit = 0;
    /** @type {Drag | null} while the slider is held */
    this.drag = null;
    byId("record-button").addEventListener("click", () => this.#record());
    byId("take-button").addEventListener("click", () => this.#record());
    byId("play-button").addEventListener("click", () => this.toggle());
    byId("play-loop").addEventListener("click", () => this.#ask({ loop: !this.replay?.loop }));
    byId("play-end").addEventListener("click", () => this.#end());
    byId("play-speed").append(...SPEEDS.map((speed) => element("option", { value: String(speed) }, `${speed}×`)));
    byId("play-speed").addEventListener("change", () => this.#ask({ speed: Number(byId("play-speed").value) }));
    byId("play-position").addEventListener("input", () => this.#scrub());
    byId("play-position").addEventListener("change", () => this.#drop());
    setInterval(() => this.#move(), STEP);
    document.addEventListener("visibilitychange", () => {
      if (!document.hidden && !this.isRefused) this.#look();
    });
    onToken(() => {
      [this.isRefused, this.isForRoom] = [false, false];
      this.#look();
    });
  }

  /** @param {string} room */
  enter(room) {
    this.room = room;
    this.visit += 1;
    this.drag = null;
    [this.replay, this.recording] = [null, null];
    // A token may be for this room and for no other, or the other way round.
    this.isRefused = false;
    this.#complain("");
    this.#show();
    this.#look();
  }

  /** @param {boolean} isOpen whether its page can be seen */
  setOpen(isOpen) {
    this.isOpen = isOpen;
    if (isOpen && !this.isRefused) this.#look();
  }

  /** Whether there is a player in the room. */
  get isReplaying() {
    return Boolean(this.replay) && !this.replay.error;
  }

  /** Plays or stands still; at the end it begins anew. */
  toggle() {
    if (this.isReplaying && this.mayControl) this.#ask({ playing: !this.replay.playing });
  }

  /**
   * Asks the server; complains where it refuses.
   * @param {string} path @param {RequestInit} [options] @returns {Promise<any>} the answer, `null` where it was refused
   */
  async #fetch(path, options) {
    try {
      const answer = await fetch(path, { ...options, headers: headers() });
      const body = await answer.json();
      if (answer.ok) return body;
      this.#complain(body.message ?? `The server refused: ${answer.status}`);
    } catch {
      this.#complain("The server does not answer.");
    }
    return null;
  }

  /** @param {string} what */
  #complain(what) {
    const text = what && what.charAt(0).toUpperCase() + what.slice(1);
    byId("take-problem").textContent = text;
    byId("take-problem").hidden = !text;
    // Also where the page of takes cannot be seen.
    byId("record-button").title = text || this.#title();
  }

  #title() {
    return this.#isRecording() ? "End the recording" : "Record this room";
  }

  #isRecording() {
    return Boolean(this.recording) && !this.recording.error;
  }

  async #look() {
    clearTimeout(this.timer);
    const visit = this.visit;
    if (!document.hidden) {
      try {
        const answer = await fetch(`/api/rooms/${this.room}/replay`, { headers: headers() });
        const said = answer.ok ? await answer.json() : null;
        if (visit !== this.visit) return;
        if (said) this.#take(said);
        // Without another token the answer stays the same; the view's link asks for one.
        this.isRefused = answer.status === 401 || answer.status === 403;
        if (this.isRefused) return;
      } catch {
        // The page says already that the server does not answer.
      }
      if (this.isOpen) await this.#list();
    }
    if (visit !== this.visit) return;
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.#look(), this.isReplaying || this.#isRecording() || this.isOpen ? BUSY : QUIET);
  }

  /** @param {any} said */
  #take(said) {
    // While somebody drags, the slider knows best.
    if (!this.drag) [this.replay, this.saidAt] = [said.replay, performance.now()];
    this.recording = said.recording;
    this.isEnabled = said.enabled;
    this.mayControl = said.control;
    if (this.recording?.error) this.#complain(`The recording has ended: ${this.recording.error}`);
    this.#show();
  }

  #show() {
    const isRecording = this.#isRecording();
    const button = byId("record-button");
    button.hidden = !this.isEnabled || !this.mayControl;
    button.setAttribute("aria-pressed", String(isRecording));
    button.setAttribute("aria-label", isRecording ? "End the recording" : "Record");
    if (byId("take-problem").hidden) button.title = this.#title();
    byId("take-button").disabled = !this.isEnabled || !this.mayControl;
    byId("take-button").textContent = isRecording ? "Stop" : "Record";
    const text = !this.isEnabled
      ? "This server keeps no recordings: start it with --record DIR."
      : isRecording
        ? `Recording: ${clockText(this.recording.seconds)}, ${sizeText(this.recording.bytes)}`
        : `Room ${this.room} is not being recorded.`;
    if (byId("take-text").textContent !== text) byId("take-text").textContent = text;

    byId("play").hidden = !this.isReplaying;
    if (!this.isReplaying) return;
    for (const part of ["play-button", "play-position", "play-speed", "play-loop", "play-end"]) byId(part).disabled = !this.mayControl;
    const { playing, speed, loop, from, to, file } = this.replay;
    byId("play").dataset.playing = String(playing);
    byId("play").title = file;
    byId("play-button").setAttribute("aria-label", playing ? "Pause" : "Play");
    byId("play-loop").setAttribute("aria-pressed", String(loop));
    const choice = byId("play-speed");
    if (document.activeElement !== choice) choice.value = SPEEDS.includes(speed) ? String(speed) : "";
    byId("play-position").min = String(from);
    byId("play-position").max = String(to);
    byId("play-length").textContent = clockText(to);
    this.#move();
  }

  #move() {
    if (!this.isReplaying) return;
    const slider = byId("play-position");
    if (!this.drag) slider.value = String(placeNow(this.replay, (performance.now() - this.saidAt) / 1000));
    const text = clockText(Number(slider.value));
    if (byId("play-time").textContent === text) return;
    byId("play-time").textContent = text;
    slider.setAttribute("aria-valuetext", text);
    fillTrack(slider);
  }

  /** @param {Record<string, any>} request */
  async #ask(request) {
    const visit = this.visit;
    const said = await this.#fetch(`/api/rooms/${this.room}/replay`, { method: "POST", body: JSON.stringify(request) });
    if (!said || visit !== this.visit) return;
    [this.replay, this.saidAt] = [said.replay, performance.now()];
    this.#complain("");
    this.#show();
  }

  // Dragging shows each place, as fast as the server takes them; the newest one always comes.

  #scrub() {
    if (!this.isReplaying) return;
    this.drag ??= { wasPlaying: this.replay.playing, wanted: null, sending: null };
    this.drag.wanted = Number(byId("play-position").value);
    this.#move();
    this.#follow(this.drag);
  }

  /** @param {Drag} drag */
  async #follow(drag) {
    if (drag.sending) return;
    while (drag.wanted !== null && drag === this.drag) {
      const position = drag.wanted;
      drag.wanted = null;
      drag.sending = this.#fetch(`/api/rooms/${this.room}/replay`, { method: "POST", body: JSON.stringify({ position, playing: false }) });
      await drag.sending;
      await new Promise((resolve) => setTimeout(resolve, SCRUB));
    }
    drag.sending = null;
  }

  async #drop() {
    if (!this.isReplaying) return;
    const { drag } = this;
    const playing = drag?.wasPlaying ?? this.replay.playing;
    const position = Number(byId("play-position").value);
    // Where it goes, it stays until the server has said so.
    Object.assign(this.replay, { position, playing: false });
    this.drag = null;
    this.saidAt = performance.now();
    // The last place asked for must not come after this one.
    await drag?.sending;
    await this.#ask({ position, playing });
  }

  async #end() {
    await this.#fetch(`/api/rooms/${this.room}/replay`, { method: "DELETE" });
    this.#look();
  }

  async #record() {
    const action = this.#isRecording() ? "stop" : "start";
    const said = await this.#fetch(`/api/rooms/${this.room}/record/${action}`, { method: "POST" });
    if (said) {
      this.recording = action === "start" ? said.recording : null;
      this.#complain("");
      this.#show();
    }
    this.#look();
  }

  async #list() {
    if (!this.mayControl) {
      this.listed = "";
      byId("take-list").replaceChildren(element("li", { class: "quiet" }, "Who may publish to this room sees its recordings."));
      return;
    }
    const said = await this.#recordings();
    if (!said) return;
    const text = JSON.stringify([said.recordings, this.isReplaying && this.replay.file]);
    // Only what changed is drawn anew: a list that is replaced takes the focus away.
    if (text === this.listed) return;
    this.listed = text;
    const list = byId("take-list");
    const focused = document.activeElement?.getAttribute("data-file");
    list.replaceChildren(...said.recordings.map((/** @type {any} */ recording) => this.#item(recording)));
    if (!said.recordings.length) list.append(element("li", { class: "quiet" }, "None yet."));
    if (focused) /** @type {HTMLElement | null} */ (list.querySelector(`[data-file="${CSS.escape(focused)}"]`))?.focus();
  }

  /** All recordings, or those of this room where the token is for it alone. */
  async #recordings() {
    if (!this.isForRoom) {
      const answer = await fetch("/api/recordings", { headers: headers() }).catch(() => null);
      if (answer?.ok) return answer.json();
      this.isForRoom = answer?.status === 401 || answer?.status === 403;
    }
    return this.#fetch(`/api/recordings?room=${this.room}`);
  }

  /** @param {{ file: string, bytes: number }} recording */
  #item({ file, bytes }) {
    const button = element("button", { "data-file": file, title: `Play ${file} in this room`, onclick: () => this.#ask({ file, playing: true }) },
      element("strong", {}, file), element("span", { class: "quiet" }, sizeText(bytes)));
    if (this.isReplaying && this.replay.file === file) button.setAttribute("aria-current", "true");
    return element("li", {}, button);
  }
}
