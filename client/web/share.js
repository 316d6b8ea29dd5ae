// Links to copy, and a QR code that a phone can read. They carry a token only where one is put in for that: not the page's own.

import { claims, token } from "./access.js";
import { drawQr } from "./qr.js";
import { byId, copyText, socketUrl } from "./util.js";

let shownRoom = "";

/** @param {string} room */
export function showLinks(room) {
  shownRoom = room;
  const given = byId("share-token").value.trim();
  const said = claims(given);
  // A link to watch must not let its reader publish.
  const [watch, publish] = ["view", "publish"].map((role) => (said?.role === role ? `#token=${given}` : ""));
  const track = `${location.origin}/track.html?room=${room}${publish}`;
  byId("share-who").textContent = token() ? "Whoever has a token for this room can open the link." : "Whoever can reach this server can open the link.";
  byId("share-with").hidden = !token();
  byId("share-token-text").textContent = aboutGiven(given, said, room);
  byId("share-view").value = `${location.origin}/?room=${room}${watch}`;
  byId("share-track").value = track;
  byId("share-obs").value = `${location.origin}/?room=${room}&bare=1&background=transparent${watch}`;
  byId("share-publish").value = socketUrl(`/v1/rooms/${room}/publish`);
  drawQr(byId("share-qr"), track);
  const isLoopback = ["localhost", "127.0.0.1", "[::1]"].includes(location.hostname);
  const problem = isLoopback
    ? "A phone cannot reach this address: open this page by the machine's own address or name first."
    : isSecureContext ? "" : "Phones give their camera only to https pages: start the server with a certificate.";
  byId("share-warning").textContent = problem;
  byId("share-warning").hidden = !problem;
}

/** What becomes of the token that was put in. @param {string} given @param {ReturnType<typeof claims>} said @param {string} room */
function aboutGiven(given, said, room) {
  if (!given) return "The links carry no token. Put one in here, and whoever gets a link gets in with it, until the token's end.";
  if (!said) return "That is no token.";
  if (!said.rooms.includes(room) && !said.rooms.includes("*")) return `That token is not for room ${room}.`;
  const end = new Date(1000 * said.exp).toLocaleString();
  if (said.role === "view") return `Whoever has the link to watch, or the one for OBS, gets in until ${end}.`;
  if (said.role === "publish") return `Whoever has the link or the code of the camera page moves this face until ${end}.`;
  return "A token of an admin does not go into links.";
}

export function listenForCopies() {
  byId("share-token").addEventListener("input", () => showLinks(shownRoom));
  for (const button of document.querySelectorAll("[data-copy]")) {
    button.addEventListener("click", async () => {
      const field = byId(/** @type {HTMLElement} */ (button).dataset.copy ?? "");
      byId("copied").textContent = (await copyText(field.value)) ? "Copied." : "Copying is not allowed here: the text is selected.";
      field.select();
    });
  }
}
