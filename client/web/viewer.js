// The Rust client as the page uses it: one face on one canvas, with the views and switches that outlive a character.

/**
 * @typedef {object} Stats
 * @property {string} state waiting, live, lost, silent, idle or offline
 * @property {number} fps pictures a second
 * @property {number} bytesPerSecond payload of packets
 * @property {number} latencyMs from a packet's arrival to the screen
 * @property {number} drawMs
 *
 * @typedef {object} ShownFrame
 * @property {Float32Array} bones x, y, z of each bone's evaluated point, metres, head space
 * @property {Float32Array} influence pose by pose, a value in `[0, 1]` for each bone
 * @property {Float32Array} zones
 */

/** A face on a canvas. Errors are of one sentence. */
export class FaceViewer {
  /** @param {any} client the WebAssembly module's own viewer */
  constructor(client) {
    this.client = client;
    this.loadedHash = "";
    this.view = "beauty";
    this.hasDrawn = false;
    /** @type {Map<string, string>} */
    this.switches = new Map();
  }

  /**
   * @param {HTMLCanvasElement} canvas
   * @param {{backend: string, transparent: boolean}} options backend is auto, webgpu or webgl
   */
  static async start(canvas, { backend, transparent }) {
    let module;
    try {
      module = await import("./rhytid_client.js");
      // Compiled as it comes, and fetched as the page's head has begun to: with the same credentials.
      await module.default({ module_or_path: fetch(new URL("./rhytid_client_bg.wasm", import.meta.url), { credentials: "same-origin" }) });
      performance.mark("rhytid:module");
    } catch (error) {
      throw new Error(`The viewer cannot be loaded: ${error instanceof Error ? error.message : error}`);
    }
    const client = await module.Viewer.start(canvas, { backend, transparent });
    performance.mark("rhytid:device");
    return new FaceViewer(client);
  }

  /** Takes over view and switches of another one. @param {FaceViewer} other */
  takeOver(other) {
    this.view = other.view;
    for (const [name, value] of other.switches) this.setSwitch(name, value);
  }

  backend() {
    return this.client.backend();
  }

  /** Why nothing can be drawn any more; undefined while all is well. @returns {string | undefined} */
  failure() {
    return this.client.failure();
  }

  /** Gives everything back. */
  close() {
    try {
      this.client.free();
    } catch {
      // A device that is gone may refuse even that.
    }
  }

  /** Takes a view socket's first message. @param {string} text */
  hello(text) {
    this.client.hello(text);
  }

  /**
   * Makes a character the one that is drawn, and gives the browser a moment half-way: what draws is compiled beside this.
   * @param {Uint8Array} glb @param {string} sha256 @param {() => boolean} isWanted asked after that moment
   * @returns {Promise<boolean>} whether it still was wanted
   */
  async load(glb, sha256, isWanted) {
    this.client.beginCharacter(glb);
    performance.mark("rhytid:outline");
    await new Promise((resolve) => setTimeout(resolve));
    if (!isWanted()) return false;
    // The same may have come twice, by a socket that broke.
    if (this.loadedHash === sha256) return true;
    this.client.finishCharacter();
    performance.mark("rhytid:character");
    this.loadedHash = sha256;
    for (const [name, value] of this.switches) this.client.setSwitch(name, value);
    if (this.views().includes(this.view)) this.client.setView(this.view);
    else this.view = "beauty";
    return true;
  }

  /** @param {Uint8Array} bytes @param {number} nowMs */
  packet(bytes, nowMs) {
    this.client.packet(bytes, nowMs);
  }

  linkLost() {
    this.client.linkLost(performance.now());
  }

  /** Device pixels. @param {number} width @param {number} height */
  resize(width, height) {
    this.client.resize(width, height);
  }

  /** Draws where there is something new. @param {number} nowMs @returns {boolean} whether it drew */
  draw(nowMs) {
    const isDrawn = this.client.draw(nowMs);
    if (isDrawn && !this.hasDrawn) {
      this.hasDrawn = true;
      performance.mark("rhytid:drawn");
      // The browser asks for the next picture once it has this one.
      requestAnimationFrame(() => performance.mark("rhytid:picture"));
    }
    return isDrawn;
  }

  /** Turns the face by a drag, device pixels. @param {number} dx @param {number} dy */
  orbit(dx, dy) {
    this.client.orbit(dx, dy);
  }

  /** @param {number} factor above 1 the face grows */
  zoom(factor) {
    this.client.zoom(factor);
  }

  resetCamera() {
    this.client.resetCamera();
  }

  /** Names of all views; none before there is a character. @returns {string[]} */
  views() {
    return Array.from(this.client.views());
  }

  /** @param {string} name */
  setView(name) {
    if (this.loadedHash) this.client.setView(name);
    this.view = name;
  }

  /** @param {string} name @param {string} value */
  setSwitch(name, value) {
    this.client.setSwitch(name, value);
    this.switches.set(name, value);
  }

  /** @returns {Stats} */
  stats() {
    return this.client.stats();
  }

  /** What the last picture shows; null before there is a character. @returns {ShownFrame | null} */
  frame() {
    return this.client.frame() ?? null;
  }
}
