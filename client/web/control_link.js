// The control socket of one source: who speaks over it speaks for that source, whatever sends its frames.

import { protocols } from "./access.js";
import { Questions } from "./questions.js";
import { socketUrl } from "./util.js";

/** Milliseconds within which a connection must be there. */
const PATIENCE = 10_000;

/** Opened by the first question, and again by the next one after it was lost. */
export class ControlLink {
  /** @param {string} room @param {string} slot */
  constructor(room, slot) {
    this.room = room;
    this.slot = slot;
    this.questions = new Questions();
    /** @type {Promise<WebSocket> | null} */
    this.socket = null;
  }

  /** @returns {Promise<WebSocket>} rejects with an Error of one sentence */
  #open() {
    this.socket ??= new Promise((resolve, reject) => {
      const socket = new WebSocket(socketUrl(`/v1/rooms/${this.room}/control?slot=${encodeURIComponent(this.slot)}`), protocols());
      const tooLate = setTimeout(() => socket.close(), PATIENCE);
      let problem = "";
      socket.onopen = () => {
        clearTimeout(tooLate);
        resolve(socket);
      };
      socket.onmessage = ({ data }) => {
        let message;
        try {
          message = JSON.parse(data);
        } catch {
          return;
        }
        if (message.type === "error") problem = message.message;
        this.questions.heard(message);
      };
      socket.onclose = () => {
        clearTimeout(tooLate);
        this.socket = null;
        this.questions.fail(problem || "the connection was lost");
        reject(new Error("the server does not answer"));
      };
    });
    return this.socket;
  }

  /**
   * @param {Record<string, any>} message
   * @param {(answer: any) => boolean} matches
   * @param {number} patience milliseconds
   * @returns {Promise<any>} rejects with an Error of one sentence; `code` is the server's where it refused
   */
  async ask(message, matches, patience = 6000) {
    const socket = await this.#open();
    return this.questions.ask(() => {
      if (socket.readyState !== WebSocket.OPEN) return false;
      socket.send(JSON.stringify(message));
      return true;
    }, matches, patience);
  }

  close() {
    this.socket?.then((socket) => socket.close(), () => {});
  }
}
