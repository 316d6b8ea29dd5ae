// The page's QR codes, read back by a decoder that has nothing to do with it.
import { createRequire } from "node:module";
import { pathToFileURL } from "node:url";
import { fileURLToPath } from "node:url";
import path from "node:path";

const here = path.dirname(fileURLToPath(import.meta.url));
const modules = process.env.RHYTID_NODE_MODULES ?? path.join(here, "node_modules");
const decode = createRequire(path.join(modules, "x.js"))("jsqr");
const { qrCode } = await import(pathToFileURL(path.join(here, "../../client/web/qr.js")).href);

function read(text) {
  const code = qrCode(text);
  const scale = 4;
  const side = (code.length + 8) * scale;
  const pixels = new Uint8ClampedArray(side * side * 4).fill(255);
  code.forEach((row, y) => row.forEach((dark, x) => {
    if (!dark) return;
    for (let dy = 0; dy < scale; dy += 1) {
      for (let dx = 0; dx < scale; dx += 1) {
        const at = 4 * (((y + 4) * scale + dy) * side + (x + 4) * scale + dx);
        pixels.fill(0, at, at + 3);
      }
    }
  }));
  return { size: code.length, found: decode(pixels, side, side) };
}

let numFailed = 0;
function check(what, isTrue) {
  console.log(`${isTrue ? "ok" : "not ok"} - ${what}`);
  if (!isTrue) numFailed += 1;
}
const sizes = new Set();
for (const length of [1, 14, 15, 26, 40, 42, 43, 62, 63, 84, 85, 106, 107, 122, 123, 152, 153, 180, 181, 200, 213]) {
  const text = Array.from({ length }, (_, i) => "https://example.org/track.html?room=Demo_1-"[(i * 7 + length) % 43]).join("");
  const { size, found } = read(text);
  sizes.add(size);
  check(`${length} bytes come back from a code of ${size} modules`, found?.data === text);
}
check("all ten versions were seen", sizes.size === 10);
check("letters beyond ASCII come back", read("Zähne, 皺").found?.data === "Zähne, 皺");
let refused = "";
try {
  qrCode("x".repeat(214));
} catch (error) {
  refused = error.message;
}
check("a text that is too long is refused", refused.includes("too long"));
process.exit(numFailed ? 1 : 0);
