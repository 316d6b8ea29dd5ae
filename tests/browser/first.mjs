// How long the first picture takes from the page's address, stage by stage, in a browser that has seen nothing yet.
//
// Environment, besides lib.mjs: RHYTID_BACKEND webgl or webgpu; RHYTID_MOST seconds that would be a fault and no busy machine.
import { WEBGPU, check, launch, open, roomName, run, until } from "./lib.mjs";

const backend = process.env.RHYTID_BACKEND ?? "webgl";
const most = Number(process.env.RHYTID_MOST ?? 20);
/** Marks of the page, and what has been done by then. */
const STAGES = { module: "module compiled", device: "graphics device", fetched: "character fetched", outline: "pipelines begun", character: "character decoded and uploaded", drawn: "picture recorded", picture: "picture shown" };

await run(async () => {
  const browser = await launch(...(backend === "webgpu" ? WEBGPU : []));
  const { page, errors } = await open(browser, `/?room=${roomName("first")}&bare=1&backend=${backend}`, { size: { width: 512, height: 512 } });
  const marks = () => page.evaluate(() => Object.fromEntries(performance.getEntriesByType("mark").map(({ name, startTime }) => [name.replace("rhytid:", ""), startTime])));
  const times = await until("the first picture", async () => {
    const all = await marks();
    return all.picture ? all : null;
  });
  const stages = Object.entries(STAGES).map(([name, what]) => `${what} ${(times[name] / 1000).toFixed(2)} s`);
  check(`${backend}: ${stages.join(", ")}`, times.picture < 1000 * most, `more than ${most} s`);
  const names = Object.keys(STAGES).map((name) => times[name]);
  check("the stages come in their order", names.every((time, i) => time > 0 && (i === 0 || i === 2 || time >= names[i - 1])), names.join());
  check("the console says nothing of errors", errors.length === 0, errors.join("; "));
  await browser.close();
});
