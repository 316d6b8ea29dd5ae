// Messages to the server that are waiting for their answers. Answers carry no number: the first question that one fits has it.

export class Questions {
  constructor() {
    /** @type {{matches: (message: any) => boolean, resolve: (message: any) => void, reject: (error: Error) => void, timer: number}[]} */
    this.waiting = [];
  }

  /**
   * @param {() => boolean} send sends the message, where it can
   * @param {(answer: any) => boolean} matches
   * @param {number} patience milliseconds
   * @returns {Promise<any>} rejects with an Error of one sentence; `code` is the server's where it refused
   */
  ask(send, matches, patience) {
    return new Promise((resolve, reject) => {
      if (!send()) {
        reject(new Error("not connected to the room yet"));
        return;
      }
      const question = { matches, resolve, reject, timer: 0 };
      question.timer = window.setTimeout(() => {
        this.waiting = this.waiting.filter((other) => other !== question);
        reject(new Error("the server did not answer in time"));
      }, patience);
      this.waiting.push(question);
    });
  }

  /** Takes a message of the server, whoever waits for it. @param {any} message */
  heard(message) {
    const at = this.waiting.findIndex((question) => question.matches(message));
    if (at < 0) return;
    const [question] = this.waiting.splice(at, 1);
    clearTimeout(question.timer);
    if (message.type === "error") question.reject(Object.assign(new Error(message.message), { code: message.code }));
    else question.resolve(message);
  }

  /** No answer will come. @param {string} why */
  fail(why) {
    for (const question of this.waiting.splice(0)) {
      clearTimeout(question.timer);
      question.reject(new Error(why));
    }
  }
}

/** Fits a refusal, but for those of frames, which nobody waits for. @param {any} message */
export const isRefusal = (message) => message.type === "error" && message.code !== "too_fast";

/** Fits an answer of this type, and a refusal. @param {string} type */
export const answerOf = (type) => (/** @type {any} */ message) => message.type === type || isRefusal(message);
