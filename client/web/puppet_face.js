// The puppet's face: where its sliders stand, how it gets there, and the frames that makes. No page, no socket, no clock.

import { EXPRESSION_FACES, SHAPES } from "./names.js";
import { clamp } from "./util.js";

/** Time constant of the easing, seconds: a hand's move, not a jump. */
const EASE = 0.09;
/** Closer than this counts as there. */
const NEAR = 0.002;

/** Sliders with values in `[0, 1]` that ease to where they are put. */
export class PuppetFace {
  constructor() {
    /** Where sliders stand: `shape:NAME`, `expression:NAME`, `pose:NAME`. @type {Map<string, number>} */
    this.targets = new Map();
    /** What is shown. @type {Map<string, number>} */
    this.values = new Map();
    /** The reference poses, by name: bones' points, and the bones' rest. @type {Map<string, Record<string, [number, number, number]>>} */
    this.poses = new Map();
    /** @type {Map<string, [number, number, number]>} */
    this.rest = new Map();
    /** @type {"weights" | "bones"} */
    this.mode = "weights";
  }

  /** @param {any} character the view hello's */
  setCharacter(character) {
    this.rest = new Map(character.bones.map((/** @type {any} */ bone) => [bone.name, bone.rest]));
    this.poses = new Map(character.poses.map((/** @type {any} */ pose) => [pose.name, pose.bones]));
  }

  /** @param {string} key @param {number} value */
  set(key, value) {
    this.targets.set(key, clamp(value, 0, 1));
    // A frame holds weights or bones: what belongs to the other kind goes back.
    if (value > 0) {
      const isPose = key.startsWith("pose:");
      for (const other of this.targets.keys()) if (other.startsWith("pose:") !== isPose) this.targets.set(other, 0);
    }
  }

  reset() {
    for (const key of this.targets.keys()) this.targets.set(key, 0);
  }

  /**
   * Eases by `seconds`.
   * @param {number} seconds
   * @returns {boolean} whether anything moved
   */
  step(seconds) {
    const share = 1 - Math.exp(-Math.max(0, seconds) / EASE);
    let hasMoved = false;
    const wantsBones = [...this.targets].some(([key, value]) => key.startsWith("pose:") && value > 0);
    const wanted = wantsBones ? "bones" : "weights";
    for (const [key, target] of this.targets) {
      // Until the kind that is shown is back at rest, the other one waits: a frame can only hold one.
      const isOfMode = (key.startsWith("pose:") ? "bones" : "weights") === this.mode;
      const goal = isOfMode && wanted === this.mode ? target : 0;
      const value = this.values.get(key) ?? 0;
      if (value === goal) continue;
      const next = value + (goal - value) * share;
      this.values.set(key, Math.abs(next - goal) < NEAR ? goal : next);
      hasMoved = true;
    }
    if (wanted !== this.mode && ![...this.values.values()].some((value) => value > 0)) {
      this.mode = wanted;
      hasMoved = true;
    }
    return hasMoved;
  }

  /**
   * The frame as it stands.
   * @param {number} t seconds
   * @returns {Record<string, any>}
   */
  frame(t) {
    return this.mode === "bones" ? { type: "frame", t, bones: this.#bones() } : { type: "frame", t, ...this.#weights() };
  }

  #weights() {
    /** @type {Record<string, number>} */
    const weights = {};
    /** @type {Record<string, number>} */
    const expressions = {};
    for (const name of SHAPES) weights[name] = this.values.get(`shape:${name}`) ?? 0;
    for (const [key, value] of this.values) {
      if (!key.startsWith("expression:") || value <= 0) continue;
      const name = key.slice("expression:".length);
      expressions[name] = round(value);
      for (const [shape, full] of Object.entries(EXPRESSION_FACES[name] ?? {})) weights[shape] += full * value;
    }
    for (const name of SHAPES) weights[name] = round(Math.min(1, weights[name]));
    // Without an expression the zones follow the weights.
    return Object.keys(expressions).length ? { weights, expressions } : { weights };
  }

  #bones() {
    /** @type {Record<string, number[]>} */
    const bones = {};
    for (const [name, points] of this.poses) {
      const value = this.values.get(`pose:${name}`) ?? 0;
      if (value <= 0) continue;
      for (const [bone, point] of Object.entries(points)) {
        const rest = this.rest.get(bone);
        if (!rest) continue;
        const at = bones[bone] ?? [...rest];
        bones[bone] = at.map((x, axis) => x + value * (point[axis] - rest[axis]));
      }
    }
    return bones;
  }
}

const round = (/** @type {number} */ value) => Math.round(value * 1000) / 1000;
