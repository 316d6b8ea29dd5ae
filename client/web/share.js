// Links to copy, and a QR code that a phone can read.

import { drawQr } from "./qr.js";
import { byId, copyText, socketUrl } from "./util.js";

/** @param {string} room */
export function showLinks(room) {
  const track = `${location.origin}/track.html?room=${room}`;
  byId("share-view").value = `${location.origin}/?room=${room}`;
  byId("share-track").value = track;
  byId("share-obs").value = `${location.origin}/?room=${room}&bare=1&background=transparent`;
  byId("share-publish").value = socketUrl(`/v1/rooms/${room}/publish`);
  drawQr(byId("share-qr"), track);
  const isLoopback = ["localhost", "127.0.0.1", "[::1]"].includes(location.hostname);
  const problem = isLoopback
    ? "A phone cannot reach this address: open this page by the machine's own address or name first."
    : isSecureContext ? "" : "Phones give their camera only to https pages: start the server with a certificate.";
  byId("share-warning").textContent = problem;
  byId("share-warning").hidden = !problem;
}

export function listenForCopies() {
  for (const button of document.querySelectorAll("[data-copy]")) {
    button.addEventListener("click", async () => {
      const field = byId(/** @type {HTMLElement} */ (button).dataset.copy ?? "");
      byId("copied").textContent = (await copyText(field.value)) ? "Copied." : "Copying is not allowed here: the text is selected.";
      field.select();
    });
  }
}
