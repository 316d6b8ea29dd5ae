// Lines over the last seconds, and maps of values, on small canvases.

/** Seconds a plot shows. */
export const SPAN = 10;
/** Most samples kept: ten seconds at 120 a second. */
const MOST = 1200;

/** Colours of lines, told apart on the dark ground by lightness too. */
export const LINES = ["#e9a178", "#7fb4e8", "#8fd19e", "#e8cf74", "#c79be8", "#ec7f7f", "#76d3cf", "#b8b4ab", "#f0b8d0", "#9aa6f2"];

/** The newest samples of a row of numbers. */
export class History {
  constructor() {
    /** @type {{at: number, values: number[]}[]} */
    this.samples = [];
  }

  /** @param {number} at seconds @param {number[]} values */
  push(at, values) {
    this.samples.push({ at, values });
    const oldest = at - SPAN - 0.5;
    let drop = Math.max(0, this.samples.length - MOST);
    while (drop < this.samples.length && this.samples[drop].at < oldest) drop += 1;
    if (drop > 64 || this.samples.length > MOST) this.samples.splice(0, drop);
  }

  clear() {
    this.samples = [];
  }
}

/**
 * Makes the canvas as sharp as the screen.
 * @param {HTMLCanvasElement} canvas
 * @returns {{context: CanvasRenderingContext2D, width: number, height: number}}
 */
export function sharp(canvas) {
  const density = Math.min(2, devicePixelRatio || 1);
  const { clientWidth: width, clientHeight: height } = canvas;
  if (canvas.width !== Math.round(width * density) || canvas.height !== Math.round(height * density)) {
    canvas.width = Math.round(width * density);
    canvas.height = Math.round(height * density);
  }
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  context.setTransform(density, 0, 0, density, 0, 0);
  return { context, width, height };
}

/**
 * Draws a history's lines.
 * @param {HTMLCanvasElement} canvas
 * @param {History} history
 * @param {{now: number, least: number, most: number, indices: number[], marks?: string[]}} what `indices` of values, line by line
 */
export function drawLines(canvas, history, { now, least, most, indices, marks = [] }) {
  const { context, width, height } = sharp(canvas);
  context.clearRect(0, 0, width, height);
  const yOf = (/** @type {number} */ value) => height - 6 - ((value - least) / (most - least)) * (height - 12);
  const xOf = (/** @type {number} */ at) => width - ((now - at) / SPAN) * width;
  context.strokeStyle = "#ffffff12";
  context.lineWidth = 1;
  for (let second = 0; second <= SPAN; second += 2) {
    const x = Math.round(xOf(now - second)) + 0.5;
    context.beginPath();
    context.moveTo(x, 0);
    context.lineTo(x, height);
    context.stroke();
  }
  if (least < 0 && most > 0) {
    context.strokeStyle = "#ffffff2e";
    context.beginPath();
    context.moveTo(0, yOf(0));
    context.lineTo(width, yOf(0));
    context.stroke();
  }
  context.lineWidth = 1.5;
  context.lineJoin = "round";
  indices.forEach((index, line) => {
    context.strokeStyle = LINES[line % LINES.length];
    context.beginPath();
    let isDown = false;
    for (const { at, values } of history.samples) {
      const value = values[index];
      if (value === undefined || Number.isNaN(value)) {
        isDown = false;
        continue;
      }
      if (isDown) context.lineTo(xOf(at), yOf(value));
      else context.moveTo(xOf(at), yOf(value));
      isDown = true;
    }
    context.stroke();
  });
  context.fillStyle = "#a5a29c";
  context.font = "10.5px system-ui, sans-serif";
  const [top, bottom] = marks;
  if (top) context.fillText(top, 6, 13);
  if (bottom) context.fillText(bottom, 6, height - 5);
}

/** The heat of a value in `[0, 1]`, dark to bright: the accent's own hue. @param {number} value */
export function heat(value) {
  const v = Math.min(1, Math.max(0, value));
  const mix = (/** @type {number} */ a, /** @type {number} */ b, /** @type {number} */ c) => Math.round(v < 0.5 ? a + (b - a) * 2 * v : b + (c - b) * (2 * v - 1));
  return `rgb(${mix(0x1c, 0xc4, 0xff)},${mix(0x1d, 0x66, 0xe2)},${mix(0x20, 0x3c, 0xb8)})`;
}
