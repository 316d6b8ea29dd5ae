// The inspector: what the packets say, over the last seconds, and what time each stage takes.

import { headers } from "./access.js";
import { History, LINES, SPAN, drawLines, heat, sharp } from "./plot.js";
import { element } from "./util.js";

/** Milliseconds between two drawings of the plots. */
const REDRAW = 50;
/** Milliseconds between two looks at the server's own measurements. */
const ASK_SERVER = 2000;
/** Frames sent from this browser whose times are remembered: five seconds at 60 a second. */
const MOST_SENT = 300;
/** Height of a bone's row in the map, page pixels. */
const ROW = 13;
/** Width of the map's names, page pixels. */
const NAMES = 118;

/** The feature points that the plot of landmarks can follow. */
const POINTS = [
  { name: "Left brow", index: 1 },
  { name: "Right brow", index: 0 },
  { name: "Upper lip", index: 2 },
  { name: "Lower lip", index: 3 },
  { name: "Left corner", index: 5 },
  { name: "Right corner", index: 4 },
];

export class Inspector {
  /** @param {HTMLElement} page */
  constructor(page) {
    this.page = page;
    /** @type {any} */
    this.character = null;
    this.coefficients = new History();
    this.zones = new History();
    this.landmarks = new History();
    this.bones = new History();
    /** When frames of this browser were captured and sent, wall clock, by their time in microseconds. @type {Map<number, {captured: number, sent: number}>} */
    this.sent = new Map();
    /** @type {Map<number, {arrived: number, stages: number[]}>} */
    this.arrived = new Map();
    /** Smoothed milliseconds of each stage; NaN where unknown. */
    this.stages = { track: NaN, network: NaN, show: NaN, solve: NaN };
    this.stagesAt = -Infinity;
    this.lastServer = { sum: NaN, count: NaN };
    this.lastSeq = -1;
    this.lastFrame = /** @type {any} */ (null);
    this.pose = -1;
    this.isOpen = false;
    this.#build();
    this.drawTimer = 0;
    this.serverTimer = 0;
  }

  #build() {
    const canvas = (/** @type {string} */ name) => element("canvas", { role: "img", "aria-label": name });
    this.latencyBar = element("div", { class: "stage-bar", "aria-hidden": "true" });
    this.latencyList = element("dl", { class: "stages" });
    this.latencyNote = element("p", { class: "quiet small-text" });
    this.poseSelect = /** @type {HTMLSelectElement} */ (element("select", { "aria-label": "Which coefficients", onchange: () => (this.pose = Number(this.poseSelect?.value)) }));
    this.coefficientPlot = canvas("Coefficients over the last ten seconds");
    this.coefficientLegend = element("ul", { class: "legend" });
    this.zonePlot = canvas("Wrinkle zones over the last ten seconds");
    this.zoneLegend = element("ul", { class: "legend" });
    this.landmarkPlot = canvas("Feature points over the last ten seconds");
    this.landmarkLegend = element("ul", { class: "legend" });
    this.landmarkTitle = element("h2", {}, "Feature points");
    this.map = canvas("Influence of each pose on each bone");
    this.page.append(
      element("h2", {}, "Latency"), this.latencyBar, this.latencyList, this.latencyNote,
      element("div", { class: "plot-head" }, element("h2", {}, "Coefficients"), this.poseSelect),
      element("div", { class: "plot" }, this.coefficientPlot, this.coefficientLegend),
      element("div", { class: "plot-head" }, element("h2", {}, "Wrinkle zones")),
      element("div", { class: "plot" }, this.zonePlot, this.zoneLegend),
      element("div", { class: "plot-head" }, this.landmarkTitle),
      element("div", { class: "plot" }, this.landmarkPlot, this.landmarkLegend),
      element("div", { class: "plot-head" }, element("h2", {}, "Influence, bones × poses")),
      element("div", { class: "plot map" }, this.map));
    this.#showStages();
  }

  /** @param {any} character the view hello's */
  setCharacter(character) {
    this.character = character;
    for (const history of [this.coefficients, this.zones, this.bones]) history.clear();
    const options = [["-1", "Strongest of each pose"], ...character.poses.map((/** @type {any} */ pose, /** @type {number} */ k) => [String(k), `${pose.name}, bone by bone`])];
    this.poseSelect?.replaceChildren(...options.map(([value, text]) => element("option", { value }, text)));
    this.pose = -1;
    const canvas = this.map;
    canvas.style.height = `${ROW * character.bones.length + 22}px`;
  }

  /** @param {boolean} isOpen */
  setOpen(isOpen) {
    if (isOpen === this.isOpen) return;
    this.isOpen = isOpen;
    clearInterval(this.drawTimer);
    clearInterval(this.serverTimer);
    if (!isOpen) return;
    this.drawTimer = setInterval(() => this.#draw(), REDRAW);
    this.serverTimer = setInterval(() => this.#askServer(), ASK_SERVER);
    this.#askServer();
  }

  /**
   * A frame left this browser.
   * @param {number} t seconds, as in the frame
   * @param {number} captured wall clock, milliseconds @param {number} sent wall clock, milliseconds
   */
  frameSent(t, captured, sent) {
    this.sent.set(Math.round(t * 1e6), { captured, sent });
    if (this.sent.size > MOST_SENT) this.sent.delete(/** @type {number} */ (this.sent.keys().next().value));
  }

  /** A packet arrived. @param {number} micros the capture time in it @param {number} now wall clock, milliseconds */
  packetArrived(micros, now) {
    // Capture times travel as whole microseconds, rounded once on each side.
    const found = this.sent.get(micros) ?? this.sent.get(micros - 1) ?? this.sent.get(micros + 1);
    if (!found) return;
    this.#mix("track", found.sent - found.captured);
    this.#mix("network", now - found.sent);
    this.stagesAt = now;
  }

  /** Smoothed feature points from the tracker in this browser. @param {number[]} points @param {number} now seconds */
  pointsSeen(points, now) {
    this.landmarks.push(now, points);
  }

  /** A picture was drawn. @param {any} frame the viewer's @param {number} playoutMs arrival to screen @param {number} nowMs */
  pictureShown(frame, playoutMs, nowMs) {
    this.#mix("show", playoutMs);
    this.lastFrame = frame;
    if (!this.character || !this.isOpen) return;
    const now = nowMs / 1000;
    const numBones = this.character.bones.length;
    const influence = /** @type {Float32Array} */ (frame.influence);
    this.coefficients.push(now, Array.from(influence));
    this.zones.push(now, Array.from(frame.zones));
    const bones = this.character.bones.map((/** @type {any} */ bone, /** @type {number} */ i) => 1000 * (frame.bones[3 * i + 1] - bone.rest[1]));
    this.bones.push(now, bones);
    this.numBones = numBones;
  }

  /** @param {"track" | "network" | "show" | "solve"} stage @param {number} value milliseconds */
  #mix(stage, value) {
    if (!Number.isFinite(value)) return;
    const last = this.stages[stage];
    this.stages[stage] = Number.isNaN(last) ? value : last + 0.1 * (value - last);
  }

  async #askServer() {
    try {
      const answer = await fetch("/metrics", { headers: headers() });
      const text = answer.ok ? await answer.text() : "";
      const number = (/** @type {string} */ name) => Number(new RegExp(`^\\w*${name}(?:\\{[^}]*\\})? ([0-9.e+-]+)`, "m").exec(text)?.[1] ?? NaN);
      const [sum, count] = [number("solve_seconds_sum"), number("solve_seconds_count")];
      if (count > this.lastServer.count) this.stages.solve = (1000 * (sum - this.lastServer.sum)) / (count - this.lastServer.count);
      this.lastServer = { sum, count };
    } catch {
      this.stages.solve = NaN;
    }
    this.#showStages();
  }

  #showStages() {
    const { track, network, show, solve } = this.stages;
    const isOwn = performance.timeOrigin + performance.now() - this.stagesAt < 3000;
    const shown = [
      ["Capture → publish", isOwn ? track : NaN, LINES[0], "tracking in this browser"],
      ["Publish → arrive", isOwn ? network - (Number.isNaN(solve) ? 0 : solve) : NaN, LINES[1], "the way to the server and back"],
      ["Solve, on the server", solve, LINES[2], "mean over all rooms"],
      ["Arrive → shown", show, LINES[3], "playout and drawing"],
    ];
    const known = shown.filter(([, value]) => Number.isFinite(value));
    const total = known.reduce((sum, [, value]) => sum + Math.max(0, /** @type {number} */ (value)), 0);
    this.latencyList?.replaceChildren(...shown.flatMap(([name, value, color, hint]) => {
      const swatch = element("i", {});
      swatch.style.cssText = `display:inline-block;width:9px;height:9px;border-radius:3px;margin-right:8px;background:${color}`;
      return [element("dt", { title: hint }, swatch, String(name)), element("dd", {}, millis(/** @type {number} */ (value)))];
    }), element("dt", {}, element("strong", {}, "Together")), element("dd", {}, element("strong", {}, millis(isOwn ? total : NaN))));
    this.latencyBar?.replaceChildren(...known.map(([, value, color]) => {
      const part = element("i", {});
      part.style.width = `${(100 * Math.max(0, /** @type {number} */ (value))) / Math.max(total, 0.001)}%`;
      part.style.background = String(color);
      return part;
    }));
    if (this.latencyNote) this.latencyNote.textContent = isOwn ? "" : "The first two are known where this browser also publishes: start the camera or move a slider.";
  }

  #draw() {
    const frame = this.lastFrame;
    if (!this.character || !frame) return;
    const now = performance.now() / 1000;
    const { poses, bones } = this.character;
    const numBones = bones.length;
    if (this.pose < 0) {
      // One line a pose: its strongest bone.
      const strongest = new History();
      strongest.samples = this.coefficients.samples.map(({ at, values }) => ({ at, values: poses.map((/** @type {any} */ _, /** @type {number} */ k) => greatest(values, k * numBones, numBones)) }));
      const indices = poses.map((/** @type {any} */ _, /** @type {number} */ k) => k);
      drawLines(this.coefficientPlot, strongest, { now, least: 0, most: 1, indices, marks: ["1", "0"] });
      legend(this.coefficientLegend, poses.map((/** @type {any} */ pose) => pose.name), indices.map((/** @type {number} */ k) => greatest(frame.influence, k * numBones, numBones)));
    } else {
      const moved = bones.map((/** @type {any} */ bone, /** @type {number} */ i) => (poses[this.pose]?.bones[bone.name] ? i : -1)).filter((/** @type {number} */ i) => i >= 0);
      const indices = moved.map((/** @type {number} */ i) => this.pose * numBones + i);
      drawLines(this.coefficientPlot, this.coefficients, { now, least: 0, most: 1, indices, marks: ["1", "0"] });
      legend(this.coefficientLegend, moved.map((/** @type {number} */ i) => bones[i].name), indices.map((/** @type {number} */ i) => frame.influence[i]));
    }
    const zones = this.character.zones ?? [];
    drawLines(this.zonePlot, this.zones, { now, least: 0, most: 1, indices: zones.map((/** @type {any} */ _, /** @type {number} */ i) => i), marks: ["1", "0"] });
    legend(this.zoneLegend, zones.length ? zones : ["This character has none"], Array.from(frame.zones));
    this.#drawPoints(now);
    this.#drawMap(frame.influence);
  }

  /** @param {number} now */
  #drawPoints(now) {
    const last = this.landmarks.samples.at(-1);
    if (last && now - last.at < SPAN) {
      // Where the camera sees them, against the eyes' distance, from where they were on average.
      const means = POINTS.map(({ index }) => {
        const values = this.landmarks.samples.map((sample) => sample.values[index]);
        return values.reduce((sum, value) => sum + value, 0) / values.length;
      });
      const centred = new History();
      centred.samples = this.landmarks.samples.map(({ at, values }) => ({ at, values: POINTS.map(({ index }, i) => values[index] - means[i]) }));
      this.landmarkTitle.textContent = "Landmarks, height";
      drawLines(this.landmarkPlot, centred, { now, least: -0.25, most: 0.25, indices: POINTS.map((_, i) => i), marks: ["¼ eye distance up", "down"] });
      legend(this.landmarkLegend, POINTS.map(({ name }) => name), []);
      return;
    }
    const bones = this.character.bones.map((/** @type {any} */ bone) => bone.name);
    const chosen = ["brow_inner_l", "brow_inner_r", "lip_upper_mid", "lip_lower_mid", "lip_corner_l", "lip_corner_r"].filter((name) => bones.includes(name));
    const names = chosen.length ? chosen : bones.slice(0, 6);
    const indices = names.map((/** @type {string} */ name) => bones.indexOf(name));
    this.landmarkTitle.textContent = "Bones, height";
    drawLines(this.landmarkPlot, this.bones, { now, least: -30, most: 30, indices, marks: ["30 mm up", "30 mm down"] });
    const values = this.bones.samples.at(-1)?.values ?? [];
    legend(this.landmarkLegend, names, indices.map((/** @type {number} */ i) => values[i]), (value) => `${value.toFixed(1)} mm`);
  }

  /** @param {Float32Array} influence */
  #drawMap(influence) {
    const { poses, bones } = this.character;
    const { context, width, height } = sharp(this.map);
    context.clearRect(0, 0, width, height);
    context.font = "10.5px system-ui, sans-serif";
    context.textBaseline = "middle";
    const column = (width - NAMES - 6) / Math.max(1, poses.length);
    poses.forEach((/** @type {any} */ pose, /** @type {number} */ k) => {
      context.fillStyle = "#a5a29c";
      context.fillText(pose.name, NAMES + k * column + 3, 9, column - 4);
      bones.forEach((/** @type {any} */ bone, /** @type {number} */ i) => {
        // A bone that the pose does not move has no influence at all.
        context.fillStyle = pose.bones[bone.name] ? heat(influence[k * bones.length + i]) : "#141517";
        context.fillRect(NAMES + k * column, 20 + i * ROW, column - 2, ROW - 1);
      });
    });
    context.fillStyle = "#c8c6c1";
    bones.forEach((/** @type {any} */ bone, /** @type {number} */ i) => context.fillText(bone.name, 6, 20 + i * ROW + ROW / 2, NAMES - 10));
  }
}

/** @param {ArrayLike<number>} values @param {number} from @param {number} length */
function greatest(values, from, length) {
  let most = 0;
  for (let i = from; i < from + length; i += 1) most = Math.max(most, values[i] ?? 0);
  return most;
}

/** @param {number} value */
function millis(value) {
  if (!Number.isFinite(value)) return "–";
  if (value < 0.95) return `${Math.round(1000 * Math.max(0, value))} µs`;
  return `${value < 9.95 ? value.toFixed(1) : Math.round(value)} ms`;
}

/**
 * @param {HTMLElement | undefined} list @param {string[]} names @param {number[]} values
 * @param {(value: number) => string} [written]
 */
function legend(list, names, values, written = (value) => `${Math.round(100 * value)} %`) {
  if (!list) return;
  if (list.children.length !== names.length || list.dataset.names !== names.join()) {
    list.dataset.names = names.join();
    list.replaceChildren(...names.map((name, i) => {
      const swatch = element("i", {});
      swatch.style.background = LINES[i % LINES.length];
      return element("li", {}, swatch, `${name} `, element("span", {}));
    }));
  }
  names.forEach((_, i) => {
    const text = values[i] === undefined || Number.isNaN(values[i]) ? "" : written(values[i]);
    const span = /** @type {HTMLElement} */ (list.children[i].lastElementChild);
    if (span.textContent !== text) span.textContent = text;
  });
}
