// Bytes of the wire that the page reads or writes itself; everything else is the Rust client's.

/** Kind of a publish frame of points. */
const KIND_POINTS = 1;
const FLAG_Z = 1;
/** Largest code of a coordinate. */
const MOST = 65535;
const HEAD = 28;

/**
 * One frame of points as the server's binary publish frame: 16-bit codes over the box that holds all points, with one step for
 * all axes. Little endian; see the README's wire section.
 * @param {Float32Array} points x, y, z of each point, pixels, y down; z in the unit of x
 * @param {number} t seconds on the sender's clock
 * @returns {Uint8Array}
 */
export function encodePoints(points, t) {
  const count = points.length / 3;
  const least = [Infinity, Infinity, Infinity];
  const most = [-Infinity, -Infinity, -Infinity];
  for (let i = 0; i < points.length; i += 1) {
    const axis = i % 3;
    least[axis] = Math.min(least[axis], points[i]);
    most[axis] = Math.max(most[axis], points[i]);
  }
  const range = Math.max(most[0] - least[0], most[1] - least[1], most[2] - least[2], 1e-3);
  const step = Math.fround((range / MOST) * (1 + 1e-6));
  const bytes = new Uint8Array(HEAD + 6 * count);
  const view = new DataView(bytes.buffer);
  view.setUint8(0, KIND_POINTS);
  view.setUint8(1, FLAG_Z);
  view.setUint16(2, count, true);
  view.setFloat64(4, t, true);
  for (let axis = 0; axis < 3; axis += 1) view.setFloat32(12 + 4 * axis, least[axis], true);
  view.setFloat32(24, step, true);
  for (let i = 0; i < points.length; i += 1) {
    const code = Math.round((points[i] - least[i % 3]) / step);
    view.setUint16(HEAD + 2 * i, Math.min(MOST, Math.max(0, code)), true);
  }
  return bytes;
}

/** Reads when the frames of packets were captured, by the sender's clock, out of the packets' heads. */
export class PacketTimes {
  constructor() {
    /** @type {{session: number, seq: number, captured: number, interval: number} | null} */
    this.key = null;
  }

  /**
   * @param {Uint8Array} bytes a packet
   * @returns {{session: number, seq: number, micros: number} | null} null where it cannot be read without an earlier key packet
   */
  read(bytes) {
    const head = bytes[0] ?? 0;
    if ((head & 0xf0) !== 0x10) return null;
    const reader = { bytes, at: 1 };
    const session = varint(reader);
    const seq = varint(reader);
    if ((head & 1) === 0) {
      const captured = varint(reader);
      const interval = varint(reader);
      if (Number.isNaN(interval)) return null;
      this.key = { session, seq, captured, interval };
      return { session, seq, micros: captured };
    }
    const distance = varint(reader);
    const zigzag = varint(reader);
    const key = this.key;
    if (!key || Number.isNaN(zigzag) || key.session !== session || key.seq !== seq - distance) return null;
    const lateness = zigzag % 2 === 0 ? zigzag / 2 : -(zigzag + 1) / 2;
    return { session, seq, micros: key.captured + distance * key.interval + lateness };
  }
}

/**
 * A little-endian base-128 number, exact below 2^53; NaN where the bytes end.
 * @param {{bytes: Uint8Array, at: number}} reader
 */
function varint(reader) {
  let value = 0;
  for (let scale = 1; reader.at < reader.bytes.length && scale < 2 ** 63; scale *= 128) {
    const byte = reader.bytes[reader.at];
    reader.at += 1;
    value += (byte & 0x7f) * scale;
    if (byte < 0x80) return value;
  }
  return NaN;
}
