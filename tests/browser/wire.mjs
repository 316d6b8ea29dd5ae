// The page's own bytes: publish frames are read back here, packets' heads from bytes written by hand.
import path from "node:path";
import { fileURLToPath, pathToFileURL } from "node:url";

const web = path.join(path.dirname(fileURLToPath(import.meta.url)), "../../client/web");
const load = (name) => import(pathToFileURL(path.join(web, name)).href);
const { PacketTimes, encodePoints } = await load("wire.js");
const { Backoff } = await load("util.js");
const { PublishLink } = await load("publish_link.js");
const { PuppetFace } = await load("puppet_face.js");
const { clockText, placeNow, sizeText } = await load("takes.js");
const { SHAPES, label, mirrored } = await load("names.js");

let numFailed = 0;
function check(what, isTrue, detail = "") {
  console.log(`${isTrue ? "ok" : "not ok"} - ${what}${isTrue ? "" : `: ${detail}`}`);
  if (!isTrue) numFailed += 1;
}

// Publish frames.
const points = Float32Array.from({ length: 3 * 478 }, (_, i) => [320 + 90 * Math.sin(i), 240 + 120 * Math.cos(2 * i), 40 * Math.sin(3 * i)][i % 3]);
const bytes = encodePoints(points, 12.345678);
const view = new DataView(bytes.buffer);
check("478 points take 2,896 bytes", bytes.length === 2896, String(bytes.length));
check("the head says kind, z and count", view.getUint8(0) === 1 && view.getUint8(1) === 1 && view.getUint16(2, true) === 478);
check("the time is exact", view.getFloat64(4, true) === 12.345678);
const step = view.getFloat32(24, true);
let worst = 0;
points.forEach((value, i) => {
  const back = view.getFloat32(12 + 4 * (i % 3), true) + step * view.getUint16(28 + 2 * i, true);
  worst = Math.max(worst, Math.abs(back - value));
});
check("points come back within half a step", worst <= 0.51 * step && step < 0.01, `${worst} of ${step}`);
const flat = new DataView(encodePoints(new Float32Array(9).fill(5), 0).buffer);
check("points that are all one make a frame too", flat.getFloat32(24, true) > 0 && flat.getUint16(28, true) === 0);

// A publisher that comes back.
const sockets = [];
globalThis.location ??= { origin: "http://face.example" };
globalThis.WebSocket = class {
  sent = [];
  constructor() { sockets.push(this); }
  send(text) { this.sent.push(JSON.parse(text)); }
  close() {}
};
const link = new PublishLink("demo", () => ({ source: "test" }), { state() {} });
link.start();
sockets[0].onopen();
sockets[0].onmessage({ data: JSON.stringify({ type: "ready", session: 7, resume_key: "a1" }) });
await sockets[0].onclose();
link.connect(false);
sockets[1].onopen();
const [firstHello, again] = [sockets[0].sent[0], sockets[1].sent[0]];
check("a first hello is nobody's who comes back", !("resume" in firstHello) && !("keep_neutral" in firstHello), JSON.stringify(firstHello));
check("who comes back names its own session", again.resume === 7 && again.resume_key === "a1" && again.keep_neutral === true && !again.takeover, JSON.stringify(again));
link.stop();
link.start();
sockets[2].onopen();
check("who starts anew takes nothing back", !("resume" in sockets[2].sent[0]));
link.stop();

// Errors that end a session: which of them the page comes back after.
const ends = async (messages, isBack) => {
  const states = [];
  const publishing = new PublishLink("demo", () => ({ source: "test" }), { state: (state) => states.push(state) });
  publishing.start();
  const mine = sockets.at(-1);
  mine.onopen();
  for (const message of [...(isBack ? [{ type: "ready", session: 7 }] : []), ...messages]) mine.onmessage({ data: JSON.stringify(message) });
  await mine.onclose();
  publishing.stop();
  return states.at(-2);
};
const error = (code) => [{ type: "error", code, message: "words" }];
check("a node that ends, or asks a cluster in vain, is come back to", (await ends([])) === "lost" && (await ends(error("shutting_down"))) === "lost" && (await ends(error("cluster"))) === "lost");
check("a slot that is taken is somebody's, unless it was one's own", (await ends(error("room_taken"))) === "taken" && (await ends(error("room_taken"), true)) === "lost");
check("so is a room at another node", (await ends(error("room_elsewhere"))) === "taken" && (await ends(error("room_elsewhere"), true)) === "lost");
check("who was sent away, or is wrong, stays away", (await ends(error("taken_over"), true)) === "taken" && (await ends(error("bad_hello"))) === "refused");

// The play bar.
check("times are minutes and seconds", clockText(0) === "0:00.0" && clockText(75.26) === "1:15.3" && clockText(59.96) === "1:00.0");
check("sizes are told in words", sizeText(10) === "1 kB" && sizeText(188_000) === "188 kB" && sizeText(2.5e9) === "2.50 GB");
const replay = { position: 8, playing: true, speed: 2, loop: false, from: 1, to: 10 };
check("a player goes on between two looks", placeNow(replay, 0.5) === 9 && placeNow({ ...replay, playing: false }, 5) === 8);
check("it stops at its end, or begins again", placeNow(replay, 4) === 10 && placeNow({ ...replay, loop: true }, 4) === 7);

// Heads of packets.
const times = new PacketTimes();
const varint = (value) => {
  const out = [];
  for (let rest = value; ; rest = Math.floor(rest / 128)) {
    if (rest < 128) return [...out, rest];
    out.push((rest % 128) + 128);
  }
};
const key = (session, seq, captured, interval) => Uint8Array.from([0x12, ...varint(session), ...varint(seq), ...varint(captured), ...varint(interval), 9, 9]);
const delta = (session, seq, distance, zigzag) => Uint8Array.from([0x13, ...varint(session), ...varint(seq), ...varint(distance), ...varint(zigzag), 9]);
check("a delta before its key says nothing", times.read(delta(1, 5, 1, 0)) === null);
check("a key says when it was captured", times.read(key(1, 4, 8_123_456_789, 33_333)).micros === 8_123_456_789);
check("a late delta is late", times.read(delta(1, 7, 3, 10)).micros === 8_123_456_789 + 3 * 33_333 + 5);
check("an early delta is early", times.read(delta(1, 7, 3, 9)).micros === 8_123_456_789 + 3 * 33_333 - 5);
check("a delta of another session says nothing", times.read(delta(2, 7, 3, 0)) === null);
check("bytes that end early say nothing", times.read(Uint8Array.from([0x12, 1, 2, 0x80])) === null && times.read(new Uint8Array()) === null);

// Tokens.
const { claims, isToken, splitFragment } = await load("access.js");
const part = (value) => Buffer.from(JSON.stringify(value)).toString("base64url");
const token = `${part({ alg: "HS256" })}.${part({ role: "view", rooms: ["d\u00f6>?"], exp: 4e9 })}.${"A".repeat(43)}`;
check("a token has three parts", isToken(token) && !isToken(token.slice(0, 80)) && !isToken(`${token}.`) && !isToken("a b.c.d") && !isToken(`${token}${"A".repeat(5000)}`));
check("a token is taken out of the fragment", splitFragment(`#token=${token}`).token === token && splitFragment(`#token=${token}`).rest === "");
check("what else stands there stays", splitFragment(`#a&token=${token}&b=1`).rest === "#a&b=1");
check("what is no token is taken out, too", splitFragment("#token=x").token === "" && splitFragment("#token=x").rest === "");
check("a token says what it is for", claims(token)?.role === "view" && claims(token)?.exp === 4e9);
check("what is no token says nothing", claims("a.b.c") === null && claims(`a.${part({ role: 3 })}.c`) === null && claims("") === null);

// Reconnecting.
const [shortest, longest] = [new Backoff(() => 0), new Backoff(() => 0.999999)];
const waits = Array.from({ length: 12 }, () => [shortest.next(), longest.next()]);
check("the first wait is short, the last no longer than eight seconds", waits[0][1] <= 250 && waits.every(([a, b]) => a <= b && b <= 8000) && waits[11][1] > 7900);
longest.reset();
check("a good connection starts the waits anew", longest.next() <= 250);

// The puppet's face.
const face = new PuppetFace();
face.setCharacter({ bones: [{ name: "a", rest: [0, 0, 0] }, { name: "b", rest: [1, 0, 0] }], poses: [{ name: "up", bones: { a: [0, 2, 0] } }] });
face.set("shape:jawOpen", 0.8);
face.step(1 / 30);
const first = face.frame(0).weights.jawOpen;
check("a slider is eased, not jumped to", first > 0.1 && first < 0.5, String(first));
for (let i = 0; i < 60; i += 1) face.step(1 / 30);
check("it gets there and rests", face.frame(0).weights.jawOpen === 0.8 && face.step(1 / 30) === false);
check("a frame names all 52 shapes", Object.keys(face.frame(0).weights).length === 52 && !("expressions" in face.frame(0)));
face.set("expression:joy", 1);
for (let i = 0; i < 60; i += 1) face.step(1 / 30);
check("an expression moves the face and says its name", face.frame(0).weights.mouthSmileLeft === 0.9 && face.frame(0).expressions.joy === 1);
face.set("pose:up", 0.5);
face.step(1 / 30);
check("a pose waits until the shapes are back at rest", "weights" in face.frame(0));
for (let i = 0; i < 120; i += 1) face.step(1 / 30);
const { bones } = face.frame(0);
check("then it moves its own bones as far as it is set", bones && Math.abs(bones.a[1] - 1) < 1e-9 && !("b" in bones), JSON.stringify(face.frame(0)));
check("every shape has a partner that has it as its own", SHAPES.every((name) => SHAPES.includes(mirrored(name)) && mirrored(mirrored(name)) === name));
check("eyes that look aside look the same way", mirrored("eyeLookInLeft") === "eyeLookOutRight" && mirrored("jawLeft") === "jawLeft");
check("labels are words", label("eyeLookUpLeft") === "Look up, left" && label("mouthLeft") === "Mouth, left");
process.exit(numFailed ? 1 : 0);
