// QR codes (ISO/IEC 18004), byte mode, error correction level M, versions 1 to 10: up to 213 bytes, enough for any address here.

/** By version from 1: data code words in all, error-correction code words a block, blocks. Level M. */
const VERSIONS = [
  [16, 10, 1], [28, 16, 1], [44, 26, 1], [64, 18, 2], [86, 24, 2],
  [108, 16, 4], [124, 18, 4], [154, 22, 4], [182, 22, 5], [216, 26, 5],
];
/** By version from 1: rows and columns of the alignment patterns' middles. */
const ALIGNMENT = [
  [], [6, 18], [6, 22], [6, 26], [6, 30], [6, 34], [6, 22, 38], [6, 24, 42], [6, 26, 46], [6, 28, 50],
];

/** Powers of 2 and their logarithms in the field of 256 elements with the polynomial 0x11d. */
const EXP = new Uint8Array(512);
const LOG = new Uint8Array(256);
for (let i = 0, value = 1; i < 255; i += 1) {
  EXP[i] = value;
  EXP[i + 255] = value;
  LOG[value] = i;
  value = value & 0x80 ? (value << 1) ^ 0x11d : value << 1;
}
const product = (/** @type {number} */ a, /** @type {number} */ b) => (a && b ? EXP[LOG[a] + LOG[b]] : 0);

/**
 * The code of `text`.
 * @param {string} text
 * @returns {boolean[][]} rows of modules, true where dark, without the quiet zone
 */
export function qrCode(text) {
  const bytes = new TextEncoder().encode(text);
  const countBits = (/** @type {number} */ version) => (version < 10 ? 8 : 16);
  const at = VERSIONS.findIndex(([words], i) => 4 + countBits(i + 1) + 8 * bytes.length <= 8 * words);
  if (at < 0) throw new Error(`text of ${bytes.length} bytes is too long for a QR code of version 10`);
  const version = at + 1;
  const words = interleaved(dataWords(bytes, VERSIONS[at][0], countBits(version)), version);
  let best = null;
  let least = Infinity;
  for (let mask = 0; mask < 8; mask += 1) {
    const modules = drawn(version, words, mask);
    const score = penalty(modules);
    if (score < least) {
      least = score;
      best = modules;
    }
  }
  return /** @type {boolean[][]} */ (best);
}

/** @param {Uint8Array} bytes @param {number} numWords @param {number} countBits */
function dataWords(bytes, numWords, countBits) {
  /** @type {number[]} */
  const bits = [];
  const put = (/** @type {number} */ value, /** @type {number} */ length) => {
    for (let i = length - 1; i >= 0; i -= 1) bits.push((value >> i) & 1);
  };
  put(0b0100, 4);
  put(bytes.length, countBits);
  for (const byte of bytes) put(byte, 8);
  put(0, Math.min(4, 8 * numWords - bits.length));
  while (bits.length % 8 !== 0) bits.push(0);
  const words = [];
  for (let i = 0; i < bits.length; i += 8) words.push(parseInt(bits.slice(i, i + 8).join(""), 2));
  for (let pad = 0xec; words.length < numWords; pad ^= 0xec ^ 0x11) words.push(pad);
  return words;
}

/** Splits data into blocks, adds each block's error correction and interleaves. @param {number[]} data @param {number} version */
function interleaved(data, version) {
  const [numData, numCorrection, numBlocks] = VERSIONS[version - 1];
  const short = Math.floor(numData / numBlocks);
  const numLong = numData % numBlocks;
  const blocks = [];
  for (let i = 0, from = 0; i < numBlocks; i += 1) {
    const length = short + (i >= numBlocks - numLong ? 1 : 0);
    blocks.push(data.slice(from, from + length));
    from += length;
  }
  const corrections = blocks.map((block) => correction(block, numCorrection));
  const words = [];
  for (let i = 0; i <= short; i += 1) for (const block of blocks) if (i < block.length) words.push(block[i]);
  for (let i = 0; i < numCorrection; i += 1) for (const block of corrections) words.push(block[i]);
  return words;
}

/** The remainder of a block by the generator polynomial of this degree (Reed-Solomon). @param {number[]} block @param {number} degree */
function correction(block, degree) {
  let generator = [1];
  for (let i = 0; i < degree; i += 1) {
    const next = new Array(generator.length + 1).fill(0);
    generator.forEach((value, j) => {
      next[j] ^= value;
      next[j + 1] ^= product(value, EXP[i]);
    });
    generator = next;
  }
  const rest = new Array(degree).fill(0);
  for (const word of block) {
    const factor = word ^ rest.shift();
    rest.push(0);
    for (let i = 0; i < degree; i += 1) rest[i] ^= product(generator[i + 1], factor);
  }
  return rest;
}

/** Remainder of `value` shifted by the degree of `divisor`. @param {number} value @param {number} divisor @param {number} degree */
function remainder(value, divisor, degree) {
  let rest = value << degree;
  for (let bit = 31 - degree; bit >= 0; bit -= 1) if ((rest >>> (bit + degree)) & 1) rest ^= divisor << bit;
  return rest;
}

const MASKS = [
  (/** @type {number} */ y, /** @type {number} */ x) => (y + x) % 2 === 0,
  (/** @type {number} */ y) => y % 2 === 0,
  (/** @type {number} */ _y, /** @type {number} */ x) => x % 3 === 0,
  (/** @type {number} */ y, /** @type {number} */ x) => (y + x) % 3 === 0,
  (/** @type {number} */ y, /** @type {number} */ x) => (Math.floor(y / 2) + Math.floor(x / 3)) % 2 === 0,
  (/** @type {number} */ y, /** @type {number} */ x) => ((y * x) % 2) + ((y * x) % 3) === 0,
  (/** @type {number} */ y, /** @type {number} */ x) => (((y * x) % 2) + ((y * x) % 3)) % 2 === 0,
  (/** @type {number} */ y, /** @type {number} */ x) => (((y + x) % 2) + ((y * x) % 3)) % 2 === 0,
];

/** @param {number} version @param {number[]} words @param {number} mask @returns {boolean[][]} */
function drawn(version, words, mask) {
  const size = 17 + 4 * version;
  /** @type {boolean[][]} */
  const modules = Array.from({ length: size }, () => new Array(size).fill(false));
  /** @type {boolean[][]} */
  const isFixed = Array.from({ length: size }, () => new Array(size).fill(false));
  const set = (/** @type {number} */ y, /** @type {number} */ x, /** @type {boolean} */ dark) => {
    if (y < 0 || x < 0 || y >= size || x >= size) return;
    modules[y][x] = dark;
    isFixed[y][x] = true;
  };
  for (let i = 0; i < size; i += 1) {
    set(6, i, i % 2 === 0);
    set(i, 6, i % 2 === 0);
  }
  for (const [top, left] of [[0, 0], [0, size - 7], [size - 7, 0]]) {
    for (let y = -1; y <= 7; y += 1) {
      for (let x = -1; x <= 7; x += 1) {
        const ring = Math.max(Math.abs(y - 3), Math.abs(x - 3));
        set(top + y, left + x, ring !== 2 && ring !== 4);
      }
    }
  }
  const middles = ALIGNMENT[version - 1];
  const end = middles.length - 1;
  middles.forEach((row, i) => middles.forEach((column, j) => {
    if ((i === 0 && j === 0) || (i === 0 && j === end) || (i === end && j === 0)) return;
    for (let y = -2; y <= 2; y += 1) for (let x = -2; x <= 2; x += 1) set(row + y, column + x, Math.max(Math.abs(y), Math.abs(x)) !== 1);
  }));
  // Level M is 0 in the format's first two bits.
  const format = ((mask << 10) | remainder(mask, 0x537, 10)) ^ 0x5412;
  for (let i = 0; i < 15; i += 1) {
    const dark = ((format >> i) & 1) === 1;
    if (i < 8) {
      set(i < 6 ? i : i + 1, 8, dark);
      set(8, size - 1 - i, dark);
    } else {
      set(8, i === 8 ? 7 : 14 - i, dark);
      set(size - 15 + i, 8, dark);
    }
  }
  set(size - 8, 8, true);
  if (version >= 7) {
    const bits = (version << 12) | remainder(version, 0x1f25, 12);
    for (let i = 0; i < 18; i += 1) {
      const [a, b] = [Math.floor(i / 3), size - 11 + (i % 3)];
      set(a, b, ((bits >> i) & 1) === 1);
      set(b, a, ((bits >> i) & 1) === 1);
    }
  }
  let bit = 0;
  let goesUp = true;
  for (let right = size - 1; right > 0; right -= 2) {
    if (right === 6) right = 5;
    for (let step = 0; step < size; step += 1) {
      const y = goesUp ? size - 1 - step : step;
      for (const x of [right, right - 1]) {
        if (isFixed[y][x]) continue;
        const word = words[bit >> 3] ?? 0;
        modules[y][x] = (((word >> (7 - (bit & 7))) & 1) === 1) !== MASKS[mask](y, x);
        bit += 1;
      }
    }
    goesUp = !goesUp;
  }
  return modules;
}

/** How hard a code is to read, by the standard's four rules. @param {boolean[][]} modules */
function penalty(modules) {
  const size = modules.length;
  let score = 0;
  const columns = modules.map((_, x) => modules.map((row) => row[x]));
  for (const line of [...modules, ...columns]) {
    let run = 0;
    for (let i = 0; i < size; i += 1) {
      run = i > 0 && line[i] === line[i - 1] ? run + 1 : 1;
      if (run === 5) score += 3;
      else if (run > 5) score += 1;
    }
    const text = line.map((dark) => (dark ? "1" : "0")).join("");
    for (const finder of ["10111010000", "00001011101"]) {
      for (let at = text.indexOf(finder); at >= 0; at = text.indexOf(finder, at + 1)) score += 40;
    }
  }
  let numDark = 0;
  for (let y = 0; y < size; y += 1) {
    for (let x = 0; x < size; x += 1) {
      if (modules[y][x]) numDark += 1;
      if (y > 0 && x > 0 && modules[y][x] === modules[y - 1][x] && modules[y][x] === modules[y][x - 1] && modules[y][x] === modules[y - 1][x - 1]) {
        score += 3;
      }
    }
  }
  return score + 10 * Math.floor(Math.abs((100 * numDark) / (size * size) - 50) / 5);
}

/**
 * Draws a code with its quiet zone, dark on light whatever the page's colours.
 * @param {HTMLCanvasElement} canvas @param {string} text
 */
export function drawQr(canvas, text) {
  const modules = qrCode(text);
  const side = modules.length + 8;
  const scale = Math.max(2, Math.floor(480 / side));
  canvas.width = side * scale;
  canvas.height = side * scale;
  const context = /** @type {CanvasRenderingContext2D} */ (canvas.getContext("2d"));
  context.fillStyle = "#fff";
  context.fillRect(0, 0, canvas.width, canvas.height);
  context.fillStyle = "#000";
  modules.forEach((row, y) => row.forEach((dark, x) => {
    if (dark) context.fillRect((x + 4) * scale, (y + 4) * scale, scale, scale);
  }));
}
