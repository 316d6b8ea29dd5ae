// Ticks that go on while the page is out of sight.

export class Clock {
  /** @param {number} interval milliseconds @param {() => void} tick */
  constructor(interval, tick) {
    this.worker = new Worker("/ticker.js");
    this.worker.onmessage = tick;
    this.worker.postMessage(interval);
  }

  stop() {
    this.worker.onmessage = null;
    this.worker.terminate();
  }
}
