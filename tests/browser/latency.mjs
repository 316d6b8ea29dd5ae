// From publish to the shown picture, in one browser: a publisher's page lets the jaw tell the time, and the viewer's page reads off
// its own pictures what time they show. Included: both sockets, the solve without smoothing, the playout delay, drawing, and the
// wait until the browser asks for the next picture. Not included: the screen's own delay, and a tracker's.
//
// Environment, besides lib.mjs: RHYTID_BACKEND webgl or webgpu.
import { URL_OF_SERVER, WEBGPU, check, faceIsThere, launch, live, open, roomName, run, until } from "./lib.mjs";

const backend = process.env.RHYTID_BACKEND ?? "webgl";
/** Pictures that are enough for a 95th percentile, and those that a slow machine must give. */
const [ENOUGH, FEWEST] = [150, 20];
/** How long pictures are gathered, milliseconds. */
const LONGEST = 40_000;
/** Milliseconds in which the jaw opens evenly; it shuts as fast. */
const RAMP = 2000;

const quantile = (sorted, share) => sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))];

await run(async () => {
  const room = roomName("latency");
  const browser = await launch(...(backend === "webgpu" ? WEBGPU : []));
  const { page, errors } = await open(browser, `/?room=${room}&bare=1&backend=${backend}`, { size: { width: 320, height: 320 } });
  await faceIsThere(page);
  const sender = await open(browser, "/healthz");
  await sender.page.evaluate(async ([address, ramp]) => {
    const socket = new WebSocket(address, "rhytid.v1");
    await new Promise((resolve) => { socket.onopen = resolve; });
    const raw = { brows: 0, lids: 0, mouth: 0, head: 0 };
    socket.send(JSON.stringify({ type: "hello", version: 1, fps: 25, source: "clock", settings: { smoothing: raw } }));
    await new Promise((resolve) => { socket.onmessage = resolve; });
    setInterval(() => {
      const wall = performance.timeOrigin + performance.now();
      const phase = wall % (2 * ramp);
      const jawOpen = phase < ramp ? phase / ramp : 2 - phase / ramp;
      socket.send(JSON.stringify({ type: "frame", t: performance.now() / 1000, weights: { jawOpen } }));
    }, 40);
  }, [`${URL_OF_SERVER.replace(/^http/, "ws")}/v1/rooms/${room}/publish`, RAMP]);
  await live(page);
  await page.evaluate(async ([ramp, jaw]) => {
    const { FaceViewer } = await import("/viewer.js");
    const draw = FaceViewer.prototype.draw;
    window.samples = [];
    let before = 1;
    FaceViewer.prototype.draw = function measured(now) {
      const isDrawn = draw.call(this, now);
      const shown = isDrawn ? this.frame()?.shapes[jaw] : undefined;
      requestAnimationFrame(() => {
        const wall = performance.timeOrigin + performance.now();
        if (shown === undefined) return;
        // Only where the jaw opens, and far enough from its turns that pictures far apart cannot be mistaken for it.
        const isOpening = shown > before && shown > 0.1 && shown < 0.7;
        before = shown;
        if (!isOpening) return;
        const told = Math.floor((wall - shown * ramp) / (2 * ramp)) * 2 * ramp + shown * ramp;
        const { latencyMs, fps } = this.stats();
        window.samples.push({ delay: wall - told, playout: latencyMs, fps });
      });
      return isDrawn;
    };
  }, [RAMP, 17]);
  const samples = () => page.evaluate(() => window.samples);
  await page.waitForTimeout(3000);
  await page.evaluate(() => { window.samples = []; });
  const end = Date.now() + LONGEST;
  await until("enough pictures", async () => {
    const { length } = await samples();
    return length >= ENOUGH || (Date.now() > end && length >= FEWEST);
  });
  const all = await samples();
  const delays = all.map(({ delay }) => delay).sort((a, b) => a - b);
  const [median, p95] = [quantile(delays, 0.5), quantile(delays, 0.95)];
  const mean = (name) => all.reduce((sum, sample) => sum + sample[name], 0) / all.length;
  const drawn = await page.evaluate(() => document.documentElement.dataset.backend);
  check(`${drawn}: publish to shown picture takes ${median.toFixed(0)} ms (median), ${p95.toFixed(0)} ms (95 %), of ${all.length} pictures; playout delay included: ${mean("playout").toFixed(0)} ms; ${mean("fps").toFixed(0)} pictures a second`,
    drawn === { webgpu: "WebGPU", webgl: "WebGL2" }[backend] && median > 0 && median < 2000, `${median} ms`);
  check("the console says nothing of errors", errors.length === 0, errors.join("; "));
  await browser.close();
});
