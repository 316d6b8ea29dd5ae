// The canvas: the Rust client's viewer, the pointer that turns and zooms it, and the clock that draws it.

import { clamp } from "./util.js";

/** Most pixels of a picture for each of the page's: what a phone's dense screen asks beyond that, nobody sees on skin. */
const MOST_DENSITY = 2;
/** Pointer travel of one press of an arrow key, page pixels. */
const KEY_TRAVEL = 24;

/** The face on the page. */
export class Stage {
  /**
   * @param {HTMLCanvasElement} canvas
   * @param {import("./viewer.js").FaceViewer} viewer
   * @param {(nowMs: number) => void} drawn called after a picture was drawn
   * @param {(error: unknown) => void} failed called once nothing can be drawn any more: the graphics device is gone
   */
  constructor(canvas, viewer, drawn, failed) {
    this.canvas = canvas;
    this.viewer = viewer;
    this.drawn = drawn;
    /** @type {Map<number, {x: number, y: number}>} */
    this.pointers = new Map();
    this.#fit();
    const observer = new ResizeObserver(() => this.#fit());
    observer.observe(canvas);
    this.#listen();
    let isOver = false;
    const end = (/** @type {unknown} */ error) => {
      if (isOver) return;
      isOver = true;
      observer.disconnect();
      failed(error);
    };
    canvas.addEventListener("webglcontextlost", () => end(new Error("The browser took the graphics device away.")));
    const tick = (/** @type {number} */ now) => {
      try {
        const failure = isOver ? undefined : this.viewer.failure();
        // Told even where nothing moves and so nothing is drawn.
        if (failure) throw new Error(`The graphics device is gone: ${failure}`);
        if (!isOver && this.viewer.draw(now)) this.drawn(now);
      } catch (error) {
        end(error);
      }
      if (!isOver) requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  density() {
    return Math.min(devicePixelRatio || 1, MOST_DENSITY);
  }

  #fit() {
    const { clientWidth, clientHeight } = this.canvas;
    if (clientWidth > 0 && clientHeight > 0) {
      this.viewer.resize(Math.round(clientWidth * this.density()), Math.round(clientHeight * this.density()));
    }
  }

  #listen() {
    const { canvas, viewer, pointers } = this;
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    });
    const forget = (/** @type {PointerEvent} */ event) => pointers.delete(event.pointerId);
    canvas.addEventListener("pointerup", forget);
    canvas.addEventListener("pointercancel", forget);
    canvas.addEventListener("pointermove", (event) => {
      const last = pointers.get(event.pointerId);
      if (!last) return;
      const spread = this.#spread();
      const [dx, dy] = [event.clientX - last.x, event.clientY - last.y];
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      if (pointers.size === 1) {
        viewer.orbit(dx * this.density(), dy * this.density());
      } else if (spread > 0 && this.#spread() > 0) {
        viewer.zoom(clamp(this.#spread() / spread, 0.5, 2));
      }
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      const lines = event.deltaMode === 1 ? 16 : 1;
      const pinch = event.ctrlKey ? 5 : 1;
      viewer.zoom(Math.exp(clamp(-event.deltaY * lines * pinch * 0.002, -0.7, 0.7)));
    }, { passive: false });
    canvas.addEventListener("dblclick", () => viewer.resetCamera());
    canvas.addEventListener("keydown", (event) => {
      const travel = KEY_TRAVEL * this.density();
      const turns = { ArrowLeft: [-travel, 0], ArrowRight: [travel, 0], ArrowUp: [0, -travel], ArrowDown: [0, travel] };
      const turn = turns[/** @type {keyof typeof turns} */ (event.key)];
      if (turn) viewer.orbit(turn[0], turn[1]);
      else if (event.key === "+" || event.key === "=") viewer.zoom(1.1);
      else if (event.key === "-") viewer.zoom(1 / 1.1);
      else return;
      event.preventDefault();
    });
  }

  /** How far two fingers are apart; 0 with one. */
  #spread() {
    const [a, b] = [...this.pointers.values()];
    return a && b ? Math.hypot(a.x - b.x, a.y - b.y) : 0;
  }
}

/**
 * Fetches a character's file as its hello describes it, and checks it where the browser can.
 * @param {{url: string, sha256: string}} character
 * @returns {Promise<Uint8Array>}
 */
export async function fetchCharacter({ url, sha256 }) {
  for (const cache of /** @type {RequestCache[]} */ (["default", "reload"])) {
    const answer = await fetch(url, { cache });
    if (!answer.ok) throw new Error(`the character's file cannot be had: the server answers ${answer.status}`);
    const bytes = new Uint8Array(await answer.arrayBuffer());
    // Only secure pages may compute hashes; elsewhere the server is believed.
    if (!crypto.subtle) return bytes;
    const hash = new Uint8Array(await crypto.subtle.digest("SHA-256", bytes));
    if ([...hash].map((byte) => byte.toString(16).padStart(2, "0")).join("") === sha256) return bytes;
  }
  throw new Error("the character's file is not the one the room moves; reload the page");
}

/**
 * Names of the expressions that a character's wrinkle zones know, out of its file; empty where it has none.
 * @param {Uint8Array} glb
 * @returns {string[]}
 */
export function expressionNames(glb) {
  try {
    const length = new DataView(glb.buffer, glb.byteOffset).getUint32(12, true);
    const json = JSON.parse(new TextDecoder().decode(glb.subarray(20, 20 + length)));
    const list = json.extensions.RHYTID_face.zones.expressions;
    return list.map((/** @type {{name: string}} */ expression) => String(expression.name));
  } catch {
    return [];
  }
}
