// The dialog that lists the server's rooms and goes to one.

import { headers } from "./access.js";
import { ROOM_NAME, byId, element } from "./util.js";

/** Milliseconds between two looks at the list while it is open. */
const REFRESH = 2000;

export class RoomPicker {
  /** @param {(room: string) => void} choose */
  constructor(choose) {
    this.choose = choose;
    this.current = "";
    /** @type {HTMLDialogElement} */
    this.dialog = byId("rooms");
    this.timer = 0;
    this.shown = "";
    byId("room-button").addEventListener("click", () => this.open());
    byId("room-form").addEventListener("submit", (/** @type {SubmitEvent} */ event) => {
      event.preventDefault();
      this.#go(byId("room-input").value.trim());
    });
    this.dialog.addEventListener("close", () => clearTimeout(this.timer));
    this.dialog.addEventListener("click", (event) => {
      if (event.target === this.dialog) this.dialog.close();
    });
  }

  open() {
    byId("room-problem").hidden = true;
    byId("room-input").value = "";
    this.shown = "";
    this.dialog.showModal();
    this.#refresh();
  }

  /** @param {string} name */
  #go(name) {
    if (!ROOM_NAME.test(name)) {
      byId("room-problem").textContent = "A room's name has 1 to 64 letters, digits, “_” or “-”.";
      byId("room-problem").hidden = false;
      return;
    }
    this.dialog.close();
    this.choose(name);
  }

  async #refresh() {
    clearTimeout(this.timer);
    const list = byId("room-list");
    try {
      const answer = await fetch("/api/rooms", { headers: headers() });
      if (answer.status === 401 || answer.status === 403) {
        this.shown = "";
        list.replaceChildren(element("li", { class: "quiet" }, "Only who may do everything sees the list of rooms. Enter the name of yours."));
        return;
      }
      const { rooms } = await answer.json();
      // Only what changed is drawn anew: a list that is replaced takes the focus away.
      const text = JSON.stringify(rooms.map((/** @type {any} */ room) => [room.name, room.viewers, describe(room)]));
      if (text !== this.shown) {
        this.shown = text;
        const focused = document.activeElement?.getAttribute("data-room");
        list.replaceChildren(...rooms.map((/** @type {any} */ room) => this.#item(room)));
        if (!rooms.length) list.append(element("li", { class: "quiet" }, "No room yet: the first viewer or tracker makes one."));
        if (focused) /** @type {HTMLElement | null} */ (list.querySelector(`[data-room="${focused}"]`))?.focus();
      }
    } catch {
      this.shown = "";
      list.replaceChildren(element("li", { class: "note" }, "The server does not answer."));
    }
    if (this.dialog.open) this.timer = setTimeout(() => this.#refresh(), REFRESH);
  }

  /** @param {any} room */
  #item(room) {
    const isCurrent = room.name === this.current;
    const button = element("button", { "data-room": room.name, onclick: () => this.#go(room.name) },
      element("strong", {}, room.name),
      element("span", { class: "quiet" }, describe(room)),
      element("span", { class: "quiet" }, room.viewers === 1 ? "1 viewer" : `${room.viewers} viewers`));
    if (isCurrent) button.setAttribute("aria-current", "true");
    return element("li", {}, button);
  }
}

/** @param {any} room */
function describe(room) {
  /** @type {string[]} */
  const sources = (room.sources ?? []).map((/** @type {any} */ source) => source.source || source.slot);
  if (sources.length > 1) return sources.join(", ");
  if (room.publisher) return room.publisher.source || "a tracker";
  return "nobody publishes";
}
