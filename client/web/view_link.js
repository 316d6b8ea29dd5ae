// The socket that brings packets. It comes back by itself until it is closed.

import { askForToken, isAboutToken, onToken, protocols, refusal } from "./access.js";
import { Backoff, socketUrl } from "./util.js";

/**
 * @typedef {object} ViewListener
 * @property {(text: string) => void} hello the first message of a connection
 * @property {(bytes: Uint8Array) => void} packet
 * @property {(state: "connecting" | "open" | "lost" | "refused", detail: string) => void} state
 */

/** Codes of errors that another attempt does not cure. */
const FINAL = new Set(["bad_room_name", "unknown_format", "forbidden_origin", "forbidden_host", "token_expired"]);

/** Milliseconds within which a connection must bring its first message. */
const PATIENCE = 10_000;

/** Watches one room. */
export class ViewLink {
  /**
   * @param {string} room
   * @param {ViewListener} listener
   */
  constructor(room, listener) {
    this.room = room;
    this.listener = listener;
    this.backoff = new Backoff();
    this.isClosed = false;
    /** @type {WebSocket | null} */
    this.socket = null;
    this.timer = 0;
    this.retryAt = 0;
    this.problem = "";
    this.isRefused = false;
    this.forgetToken = onToken(() => {
      if (this.isRefused) this.connect();
    });
    this.hurry = () => {
      if (!document.hidden && !this.socket && !this.isClosed && !this.isRefused) this.connect();
    };
    addEventListener("online", this.hurry);
    document.addEventListener("visibilitychange", this.hurry);
    this.connect();
  }

  connect() {
    clearTimeout(this.timer);
    this.problem = "";
    this.isRefused = false;
    let isFinal = false;
    let code = "";
    let hasHello = false;
    this.listener.state("connecting", "");
    const socket = new WebSocket(socketUrl(`/v1/rooms/${this.room}/view`), protocols());
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    const tooLate = setTimeout(() => socket.close(), PATIENCE);
    socket.onmessage = ({ data }) => {
      clearTimeout(tooLate);
      if (typeof data !== "string") {
        this.listener.packet(new Uint8Array(data));
        return;
      }
      const message = parsed(data);
      if (message?.type === "error") {
        this.problem = message.message;
        code = message.code;
        isFinal = FINAL.has(code);
      } else if (!hasHello && message?.type === "hello") {
        hasHello = true;
        this.backoff.reset();
        this.listener.hello(data);
        this.listener.state("open", "");
      }
    };
    let wasOpen = false;
    socket.onopen = () => (wasOpen = true);
    socket.onclose = async () => {
      clearTimeout(tooLate);
      if (this.socket !== socket || this.isClosed) return;
      if (!wasOpen) {
        const refused = await refusal("view", this.room);
        // The link may have been closed meanwhile.
        if (this.socket !== socket || this.isClosed) return;
        if (refused) [this.problem, code, isFinal] = [refused.message, refused.code, true];
      }
      this.socket = null;
      if (isFinal) {
        this.isRefused = isAboutToken(code);
        this.listener.state("refused", this.problem);
        if (this.isRefused) askForToken(this.problem);
        return;
      }
      const wait = this.backoff.next();
      this.retryAt = performance.now() + wait;
      this.listener.state("lost", this.problem || "The server does not answer");
      this.timer = setTimeout(() => this.connect(), wait);
    };
  }

  /** Ends it for good. */
  close() {
    this.isClosed = true;
    this.forgetToken();
    clearTimeout(this.timer);
    removeEventListener("online", this.hurry);
    document.removeEventListener("visibilitychange", this.hurry);
    this.socket?.close();
    this.socket = null;
  }
}

/** @param {string} text @returns {any} */
function parsed(text) {
  try {
    return JSON.parse(text);
  } catch {
    return null;
  }
}
