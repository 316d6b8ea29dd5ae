// One picture by the client in the browser, for a comparison with the native one: packets go in at given moments, the canvas
// comes out as a PNG. Measures how long the first picture takes from nothing.
//
// Environment, besides lib.mjs: RHYTID_JOB a JSON file {backend, size, hello, packets: [[ms, bytes], …], draws: [ms, …], png,
// mostFirstPicture}, whose `png` is written.
import fs from "node:fs";
import { WEBGPU, check, launch, open, run } from "./lib.mjs";

const job = JSON.parse(fs.readFileSync(process.env.RHYTID_JOB, "utf8"));

/** Runs in the page. */
async function draw({ backend, size, hello, packets, draws }) {
  const times = {};
  let last = performance.now();
  const step = (name) => {
    const now = performance.now();
    times[name] = Math.round(now - last);
    last = now;
  };
  const start = last;
  const module = await import("/rhytid_client.js");
  await module.default();
  step("module");
  const canvas = Object.assign(document.createElement("canvas"), { width: size, height: size });
  document.body.replaceChildren(canvas);
  const viewer = await module.Viewer.start(canvas, { backend, transparent: false });
  step("device");
  const glb = new Uint8Array(await (await fetch(JSON.parse(hello).character.url)).arrayBuffer());
  step("character fetched");
  viewer.hello(hello);
  viewer.beginCharacter(glb);
  step("character begun");
  viewer.finishCharacter();
  step("character ready");
  viewer.resize(size, size);
  let png = "";
  let next = 0;
  for (const [i, ms] of draws.entries()) {
    while (next < packets.length && packets[next][0] <= ms) {
      viewer.packet(Uint8Array.from(packets[next][1]), packets[next][0]);
      next += 1;
    }
    const isDrawn = viewer.draw(ms);
    if (!isDrawn) throw new Error(`nothing is drawn at ${ms} ms`);
    // In the same task: afterwards the browser has taken the picture. Waits for what was drawn.
    png = canvas.toDataURL("image/png");
    if (i === 0) {
      step("first picture");
      times.all = Math.round(last - start);
    }
  }
  step("other pictures");
  return { png, times, backend: viewer.backend(), stats: viewer.stats() };
}

await run(async () => {
  const flags = job.backend === "webgpu" ? WEBGPU : [];
  const browser = await launch(...flags);
  // A text of the same origin: no page that draws, too.
  const { page, errors } = await open(browser, "/healthz", { size: { width: job.size, height: job.size } });
  const { png, times, backend, stats } = await page.evaluate(draw, job);
  console.log(`# ${backend}: ${JSON.stringify(times)} ms`);
  console.log(`# ${JSON.stringify(stats)}`);
  fs.writeFileSync(job.png, Buffer.from(png.split(",")[1], "base64"));
  check(`drawn with ${backend}`, backend === { webgpu: "WebGPU", webgl: "WebGL2" }[job.backend]);
  check(`the first picture comes within ${job.mostFirstPicture} s`, times.all <= 1000 * job.mostFirstPicture, `${times.all} ms`);
  check("the console says nothing of errors", errors.length === 0, errors.join("; "));
  await browser.close();
});
