// Nodes of a cluster behind one address, as a balancer or a name of several addresses makes them: the page that publishes through
// it goes on at another node when its own dies or is restarted, in its slot, with its neutral face and settings.
//
// Environment, besides lib.mjs: RHYTID_SERVER the server's program, RHYTID_NATS that of NATS.
import { spawn } from "node:child_process";
import { mkdtempSync, rmSync } from "node:fs";
import net from "node:net";
import { tmpdir } from "node:os";
import path from "node:path";
import { check, faceIsThere, launch, live, open, roomName, run, text, until } from "./lib.mjs";

/** The face is to be back at the other node within two seconds. */
const MOST_GONE = 2000;

function start(program, args) {
  const child = spawn(program, args, { stdio: ["ignore", "pipe", "ignore"] });
  process.on("exit", () => child.kill("SIGKILL"));
  return child;
}

const freePort = () => new Promise((resolve) => {
  const server = net.createServer().listen(0, "127.0.0.1", () => {
    const { port } = server.address();
    server.close(() => resolve(port));
  });
});

async function startNats() {
  const folder = mkdtempSync(path.join(tmpdir(), "rhytid-nats-"));
  process.on("exit", () => rmSync(folder, { recursive: true, force: true }));
  const port = await freePort();
  start(process.env.RHYTID_NATS ?? "nats-server", ["-js", "-a", "127.0.0.1", "-p", String(port), "-sd", folder]);
  await until("NATS", () => new Promise((resolve) => {
    const socket = net.connect(port, "127.0.0.1", () => resolve(true));
    socket.on("error", () => resolve(false)).on("connect", () => socket.destroy());
  }));
  return `nats://127.0.0.1:${port}`;
}

/** A node, once it has joined. */
async function startNode(nats) {
  const child = start(process.env.RHYTID_SERVER ?? "rhytid-server", ["serve", "--listen", "127.0.0.1:0", "--cluster", nats]);
  const line = await new Promise((resolve, reject) => {
    child.on("error", reject);
    child.on("exit", () => reject(new Error("a node ended at once")));
    child.stdout.once("data", (data) => resolve(String(data)));
  });
  const port = Number(/:(\d+)\s/.exec(line)?.[1]);
  const get = async (what) => (await fetch(`http://127.0.0.1:${port}${what}`)).text();
  await until("a node's joining", async () => (await get("/healthz")) === "ok\n");
  const end = (signal) => new Promise((resolve) => {
    child.on("exit", resolve);
    child.kill(signal);
  });
  const room = async (name) => JSON.parse(await get("/api/rooms")).rooms.find((room) => room.name === name);
  const id = JSON.parse(await get("/api/rooms")).node;
  return { port, id, end, room };
}

/** One address before all nodes: a connection goes to the first of them that takes it. */
function balancer(nodes) {
  const server = net.createServer((from) => {
    const connect = (tried) => {
      const node = nodes[tried];
      if (!node) return from.destroy();
      const to = net.connect(node.port, "127.0.0.1");
      to.once("error", () => connect(tried + 1)).once("connect", () => {
        to.removeAllListeners("error");
        for (const [one, other] of [[from, to], [to, from]]) one.on("error", () => other.destroy()).on("close", () => other.destroy());
        from.pipe(to).pipe(from);
      });
    };
    from.on("error", () => {});
    connect(0);
  });
  return new Promise((resolve) => server.listen(0, "127.0.0.1", () => resolve(`http://127.0.0.1:${server.address().port}`)));
}

/** Asks the puppet's source what it takes as a message, over a socket of its own; gives the answer of that type. */
const ask = (page, room, message, type) => page.evaluate(([name, text, wanted]) => new Promise((resolve, reject) => {
  const socket = new WebSocket(`${location.origin.replace(/^http/, "ws")}/v1/rooms/${name}/control?slot=puppet`, "rhytid.v1");
  socket.onopen = () => socket.send(text);
  socket.onclose = () => reject(new Error("the control socket closed"));
  socket.onmessage = ({ data }) => {
    const answer = JSON.parse(data);
    if (answer.type === "error") reject(new Error(data));
    if (answer.type !== wanted) return;
    resolve(answer);
    socket.close();
  };
}), [room, JSON.stringify(message), type]);

await run(async () => {
  const nats = await startNats();
  const nodes = [await startNode(nats), await startNode(nats)];
  const [first, second] = nodes;
  const address = await balancer(nodes);
  const room = roomName("nodes");
  const browser = await launch();
  const { page } = await open(browser, `${address}/?room=${room}&view=bare`, { size: { width: 700, height: 300 } });
  await faceIsThere(page);
  if (!(await page.isVisible("#panel"))) await page.keyboard.press("h");
  await page.click("#tab-puppet");
  const brow = page.locator("#slider-shape-browInnerUp");
  await brow.fill("0.05");
  await live(page);
  await ask(page, room, { type: "calibrate" }, "calibrating");
  const neutral = await until("a neutral that was asked for", async () => {
    const kept = (await first.room(room))?.neutral;
    return kept?.requested && kept;
  });
  await ask(page, room, { type: "settings", gains: { mouth: 0.75 } }, "settings");
  await brow.fill("0.6");
  // Who watches at the node that stays.
  const { page: other } = await open(browser, `http://127.0.0.1:${second.port}/healthz`);
  await other.evaluate((name) => {
    window.seen = [];
    new WebSocket(`${location.origin.replace(/^http/, "ws")}/v1/rooms/${name}/view?format=json`, "rhytid.v1").onmessage = ({ data }) => {
      const { type, session, seq } = JSON.parse(data);
      if (type === "frame") window.seen.push({ at: performance.now(), session, seq });
    };
  }, room);
  await until("the face at the other node", () => other.evaluate(() => window.seen.length > 3));
  // What a performer has changed last is on its way to the cluster.
  await page.waitForTimeout(500);

  const goesOnAt = async (node, what) => {
    await until("the face's home at another node", async () => {
      const at = await node.room(room);
      return at?.node === node.id && at.sources.some((source) => source.slot === "puppet" && source.live);
    });
    await live(page);
    const at = await node.room(room);
    check(`${what}: the page publishes at another node, in its own slot`, at.sources.length === 1 && at.sources[0].source === "puppeteer", JSON.stringify(at.sources));
    check(`${what}: its neutral face is the one from before`, at.neutral?.t === neutral.t && at.neutral?.num_frames === neutral.num_frames, `${JSON.stringify(at.neutral)} after ${JSON.stringify(neutral)}`);
    const { gains } = await ask(page, room, { type: "settings" }, "settings");
    check(`${what}: its settings are those from before`, gains?.mouth === 0.75, JSON.stringify(gains));
    check(`${what}: its slider stands where it was`, (await brow.inputValue()) === "0.6");
    check(`${what}: the page was not loaded again`, await page.evaluate(() => window.isTheSame === true));
  };
  // A hand that does not rest: a face that does is sent only now and then.
  await page.evaluate(() => {
    window.isTheSame = true;
    const slider = document.getElementById("slider-shape-jawOpen");
    window.hand = setInterval(() => {
      slider.value = String(0.3 + 0.2 * Math.sin(performance.now() / 300));
      slider.dispatchEvent(new Event("input", { bubbles: true }));
    }, 100);
  });
  await page.waitForTimeout(500);

  await first.end("SIGKILL");
  await goesOnAt(second, "killed");
  await page.waitForTimeout(500);
  const seen = await other.evaluate(() => window.seen);
  const pauses = seen.slice(1).map(({ at }, i) => at - seen[i].at);
  const lost = seen.findIndex(({ session }) => session > seen[0].session) - 1;
  const gone = pauses[lost];
  // Where the processor draws, the page comes to its sockets and its slider seldom enough: a turn for each step of coming back.
  const slow = Math.max(...pauses.slice(Math.max(0, lost - 10), lost));
  console.log(`killed: a viewer at another node has not seen the face for ${gone.toFixed(0)} ms, and for ${slow.toFixed(0)} ms before`);
  check("killed: viewers elsewhere see the face again soon", gone < MOST_GONE + 4 * slow, `after ${gone} ms, with ${slow} ms between frames before`);
  const isForwards = seen.slice(1).every((after, i) => after.session > seen[i].session || (after.session === seen[i].session && after.seq > seen[i].seq));
  check("killed: nothing they see goes backwards", isForwards && seen.at(-1).session > seen[0].session);

  const third = await startNode(nats);
  nodes.push(third);
  await second.end("SIGTERM");
  await goesOnAt(third, "restarted");
  check("the page says that it moves the face", (await text(page, "#panel")).includes(`You move the face of room ${room}`));
  await browser.close();
  await third.end("SIGTERM");
});
