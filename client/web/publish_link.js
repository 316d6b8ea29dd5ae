// The socket that publishes: hello, frames, settings and questions. It comes back by itself, unless somebody else has the room.

import { askForToken, isAboutToken, onToken, protocols, refusal } from "./access.js";
import { Questions } from "./questions.js";
import { Backoff, socketUrl } from "./util.js";

/**
 * @typedef {"off" | "connecting" | "ready" | "taken" | "refused" | "lost"} PublishState
 * @typedef {object} PublishListener
 * @property {(state: PublishState, detail: string) => void} state
 * @property {(message: any) => void} [message] every answer of the server, errors too
 */

/** Bytes that may wait in the socket: more means a slow network, and the newest frame is worth more than an old one. */
const MOST_WAITING = 48 << 10;
/** How long an own session that broke off may still hold the room, milliseconds: the server's idle time and a little. */
const OWN_GHOST = 20_000;

/** Codes of errors that say who else has the slot, or the whole room at another node of a cluster. */
const TAKEN = new Set(["room_taken", "slot_taken", "room_elsewhere"]);
/** Codes of errors that another attempt may cure, by the same node or by another behind the same address. */
const PASSING = new Set(["shutdown", "shutting_down", "cluster", "idle", "too_many_rooms", "too_many_connections", "hello_timeout"]);

/** Milliseconds within which a connection must be answered. */
const PATIENCE = 10_000;

/** Publishes to one room. */
export class PublishLink {
  /**
   * @param {string} room
   * @param {() => Record<string, any>} hello makes the hello's fields, without type and version
   * @param {PublishListener} listener
   */
  constructor(room, hello, listener) {
    this.room = room;
    this.hello = hello;
    this.listener = listener;
    /** @type {PublishState} */
    this.state = "off";
    this.backoff = new Backoff();
    /** @type {WebSocket | null} */
    this.socket = null;
    this.timer = 0;
    this.wasReadyAt = -Infinity;
    /** Of the last session that was ready its number and key: who comes back takes its own slot back with them. */
    this.own = { resume: 0 };
    this.numFrames = 0;
    this.numSkipped = 0;
    this.bytes = 0;
    this.questions = new Questions();
    /** Ends the waiting for another token. */
    this.forgetToken = () => {};
  }

  /** @param {{takeover?: boolean}} [how] */
  start({ takeover = false } = {}) {
    this.stop();
    this.wasReadyAt = -Infinity;
    this.connect(takeover);
  }

  stop() {
    clearTimeout(this.timer);
    this.forgetToken();
    const socket = this.socket;
    this.socket = null;
    socket?.close();
    this.questions.fail("publishing has been stopped");
    this.#become("off", "");
  }

  /** @param {boolean} takeover */
  connect(takeover) {
    clearTimeout(this.timer);
    this.#become("connecting", "");
    const socket = new WebSocket(socketUrl(`/v1/rooms/${this.room}/publish`), protocols());
    this.socket = socket;
    let last = { code: "", message: "" };
    let wasOpen = false;
    socket.onopen = () => {
      wasOpen = true;
      const again = this.wasReadyAt > -Infinity;
      const hello = { type: "hello", version: 1, ...this.hello(), takeover, ...(again ? { keep_neutral: true, ...this.own } : {}) };
      socket.send(JSON.stringify(hello));
    };
    const tooLate = setTimeout(() => socket.close(), PATIENCE);
    socket.onmessage = ({ data }) => {
      clearTimeout(tooLate);
      if (this.socket !== socket || typeof data !== "string") return;
      let message;
      try {
        message = JSON.parse(data);
      } catch {
        return;
      }
      if (message.type === "error") last = message;
      if (message.type === "ready") {
        this.backoff.reset();
        this.wasReadyAt = performance.now();
        this.own = { resume: message.session, resume_key: message.resume_key };
        this.#become("ready", "");
      }
      this.questions.heard(message);
      this.listener.message?.(message);
    };
    socket.onclose = async () => {
      clearTimeout(tooLate);
      if (this.socket !== socket) return;
      if (!wasOpen) {
        const refused = await refusal("publish", this.room);
        // It may have been stopped meanwhile.
        if (this.socket !== socket) return;
        if (refused) last = refused;
      }
      this.socket = null;
      this.questions.fail(last.message || "the connection was lost");
      if (this.state === "ready") this.wasReadyAt = performance.now();
      this.#ended(last);
    };
  }

  /** @param {{code: string, message: string}} last */
  #ended({ code, message }) {
    const isTaken = TAKEN.has(code);
    const mayBeOwnGhost = performance.now() - this.wasReadyAt < OWN_GHOST;
    if (code === "taken_over" || (isTaken && !mayBeOwnGhost)) {
      this.#become("taken", message);
    } else if (code && !isTaken && !PASSING.has(code)) {
      this.#become("refused", message);
      if (isAboutToken(code)) {
        askForToken(message);
        this.forgetToken();
        this.forgetToken = onToken(() => this.start());
      }
    } else {
      this.#become("lost", message || "The server does not answer");
      this.timer = setTimeout(() => this.connect(false), this.backoff.next());
    }
  }

  /**
   * Sends a frame, as an object or as bytes. A frame that would only wait is left out.
   * @param {Record<string, any> | ArrayBuffer | Uint8Array} frame
   * @returns {boolean} whether it went out
   */
  sendFrame(frame) {
    const socket = this.socket;
    if (this.state !== "ready" || !socket) return false;
    if (socket.bufferedAmount > MOST_WAITING) {
      this.numSkipped += 1;
      return false;
    }
    const isBytes = frame instanceof ArrayBuffer || ArrayBuffer.isView(frame);
    const data = isBytes ? frame : JSON.stringify(frame);
    socket.send(/** @type {any} */ (data));
    this.numFrames += 1;
    this.bytes += isBytes ? /** @type {ArrayBuffer} */ (frame).byteLength : /** @type {string} */ (data).length;
    return true;
  }

  /**
   * Sends a message that is not a frame.
   * @param {Record<string, any>} message
   * @returns {boolean} whether it went out
   */
  send(message) {
    if (this.state !== "ready" || !this.socket) return false;
    this.socket.send(JSON.stringify(message));
    return true;
  }

  /**
   * Sends a message and waits for its answer.
   * @param {Record<string, any>} message
   * @param {(answer: any) => boolean} matches
   * @param {number} patience milliseconds
   * @returns {Promise<any>} rejects with an Error of one sentence; `code` is the server's where it refused
   */
  ask(message, matches, patience = 4000) {
    return this.questions.ask(() => this.send(message), matches, patience);
  }

  /** @param {PublishState} state @param {string} detail */
  #become(state, detail) {
    if (state === this.state && !detail) return;
    this.state = state;
    this.listener.state(state, detail);
  }
}

/**
 * How a publisher's state reads.
 * @param {PublishState} state @param {string} room @param {string} detail
 */
export function publishSentence(state, room, detail) {
  switch (state) {
    case "off": return "Not publishing.";
    case "connecting": return `Connecting to room ${room}…`;
    case "ready": return `Publishing to room ${room}.`;
    case "taken": return `Somebody else publishes to room ${room}.`;
    case "refused": return `The server refused: ${detail}`;
    case "lost": return `Reconnecting: ${detail}`;
  }
}
