// Ticks that go on while the page is out of sight.

export class Clock {
  /**
   * @param {number} interval milliseconds from one tick's end to the next: where the page has no time, ticks do not pile up
   * @param {() => void} tick
   */
  constructor(interval, tick) {
    this.worker = new Worker("/ticker.js");
    this.worker.onmessage = () => {
      tick();
      this.worker.postMessage(interval);
    };
    this.worker.postMessage(interval);
  }

  stop() {
    this.worker.onmessage = null;
    this.worker.terminate();
  }
}
