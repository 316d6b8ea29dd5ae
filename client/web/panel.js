// The panel at the side, or at the bottom of a phone, and its tabs.

import { byId, storage } from "./util.js";

export class Panel {
  /** @param {string[]} names of the tabs @param {(name: string | null) => void} shown which tab can be seen now */
  constructor(names, shown) {
    this.names = names;
    this.shown = shown;
    this.name = storage.read("tab") ?? names[0];
    if (!names.includes(this.name)) this.name = names[0];
    this.isOpen = false;
    for (const name of names) {
      const tab = byId(`tab-${name}`);
      tab.addEventListener("click", () => this.choose(name));
      tab.addEventListener("keydown", (/** @type {KeyboardEvent} */ event) => {
        const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
        if (!step) return;
        event.preventDefault();
        event.stopPropagation();
        const next = names[(names.indexOf(name) + step + names.length) % names.length];
        this.choose(next);
        byId(`tab-${next}`).focus();
      });
    }
    byId("panel-button").addEventListener("click", () => this.toggle());
    byId("panel-close").addEventListener("click", () => {
      this.toggle(false);
      byId("panel-button").focus();
    });
    this.#show();
  }

  /** @param {string} name */
  choose(name) {
    this.name = name;
    storage.write("tab", name);
    this.#show();
  }

  next() {
    this.choose(this.names[(this.names.indexOf(this.name) + 1) % this.names.length]);
  }

  toggle(isOpen = !this.isOpen) {
    this.isOpen = isOpen;
    this.#show();
  }

  #show() {
    byId("panel").hidden = !this.isOpen;
    byId("panel-button").setAttribute("aria-expanded", String(this.isOpen));
    document.body.classList.toggle("has-panel", this.isOpen);
    for (const name of this.names) {
      const isOn = name === this.name;
      const tab = byId(`tab-${name}`);
      tab.setAttribute("aria-selected", String(isOn));
      tab.tabIndex = isOn ? 0 : -1;
      byId(`page-${name}`).hidden = !isOn;
    }
    this.shown(this.isOpen ? this.name : null);
  }
}
