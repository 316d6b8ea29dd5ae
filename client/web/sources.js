// The room's sources: who is there, who drives what, and what a phone's tracker cannot be told on the phone.

import { ControlLink } from "./control_link.js";
import { listProfiles, readProfile, saveProfile } from "./profiles.js";
import { headers } from "./access.js";
import { answerOf } from "./questions.js";
import { Settings } from "./settings.js";
import { element } from "./util.js";
import { Wizard } from "./wizard.js";

/** Milliseconds between two looks at the list while it is open. */
const REFRESH = 1000;
const GROUPS = [["brows", "Brows"], ["lids", "Lids"], ["gaze", "Gaze"], ["mouth", "Mouth"], ["head", "Head"]];

/**
 * @typedef {object} Listing a source as the server lists it
 * @property {string} slot
 * @property {string} source what it calls itself
 * @property {number} priority
 * @property {string[]} groups it may drive
 * @property {boolean} live
 * @property {string[]} drives
 * @property {number} seconds
 */

export class Sources {
  /** @param {HTMLElement} page @param {string} room */
  constructor(page, room) {
    this.room = room;
    this.isOpen = false;
    this.timer = 0;
    /** Counts looks: the answer to an older one says nothing. */
    this.look = 0;
    /** @type {Map<string, Card>} */
    this.cards = new Map();
    /** @type {Card | null} */
    this.fitted = null;
    this.wizard = new Wizard({
      ask: (message, matches, patience) => /** @type {Card} */ (this.fitted).link.ask(message, matches, patience),
      done: (answer) => /** @type {Card} */ (this.fitted).fitted(answer),
      apply: (offers) => /** @type {Card} */ (this.fitted).change(offers),
      save: (profile) => saveProfile(profile),
      opened: () => {},
    }, false);
    this.note = element("p", { class: "quiet", role: "status" }, "Looking…");
    this.list = element("ul", { class: "sources", "aria-label": "Sources of this room" });
    page.append(this.note, this.list,
      element("p", { class: "quiet small-text" }, "The live source of the highest priority drives each part of the face; at equal ones, the one that came last."));
  }

  /** @param {boolean} isOpen */
  setOpen(isOpen) {
    if (isOpen === this.isOpen) return;
    this.isOpen = isOpen;
    clearTimeout(this.timer);
    if (isOpen) this.#refresh();
  }

  /** @param {string} room */
  enter(room) {
    if (room === this.room) return;
    this.room = room;
    this.#show([]);
    this.note.textContent = "Looking…";
    if (this.isOpen) this.#refresh();
  }

  async #refresh() {
    clearTimeout(this.timer);
    this.look += 1;
    const mine = this.look;
    try {
      const answer = await fetch(`/api/rooms?room=${this.room}`, { headers: headers() });
      if (mine !== this.look) return;
      if (answer.status === 401 || answer.status === 403) {
        this.#show([]);
        say(this.note, "The sources are shown to who may watch this room.");
        return;
      }
      const { rooms } = await answer.json();
      if (mine !== this.look) return;
      const found = rooms.find((/** @type {any} */ room) => room.name === this.room);
      this.#show(found?.sources ?? []);
    } catch {
      if (mine !== this.look) return;
      say(this.note, "The server does not answer.");
    }
    if (this.isOpen) this.timer = setTimeout(() => this.#refresh(), REFRESH);
  }

  /** @param {Listing[]} listed */
  #show(listed) {
    for (const [slot, card] of this.cards) {
      if (listed.some((source) => source.slot === slot)) continue;
      card.link.close();
      // Where the focus was lost with a card, the list has it: keys go on from there.
      const hadFocus = card.item.contains(document.activeElement);
      card.item.remove();
      this.cards.delete(slot);
      if (hadFocus) this.list.querySelector("button")?.focus();
    }
    const sorted = [...listed].sort((a, b) => b.priority - a.priority || a.slot.localeCompare(b.slot));
    for (const [i, source] of sorted.entries()) {
      let card = this.cards.get(source.slot);
      if (!card) {
        card = new Card(this.room, source.slot, (asking) => this.#fit(asking));
        this.cards.set(source.slot, card);
      }
      // Moved only where the order changed: a moved element loses the focus.
      if (this.list.children[i] !== card.item) this.list.insertBefore(card.item, this.list.children[i] ?? null);
      card.show(source);
    }
    const count = listed.filter((source) => source.live).length;
    say(this.note, !listed.length
      ? "Nobody sends to this room. Start the camera, or send with a tracker."
      : `${listed.length === 1 ? "1 source" : `${listed.length} sources`}, ${count} live`);
  }

  /** @param {Card} card */
  #fit(card) {
    this.fitted = card;
    this.wizard.open(card.name);
  }
}

/** Changes a text only where it is another one: a screen reader tells every change. @param {HTMLElement} place @param {string} text */
function say(place, text) {
  if (place.textContent !== text) place.textContent = text;
}

/** @param {unknown} error */
const messageOf = (error) => (error instanceof Error ? error.message : String(error));

/** One source. */
class Card {
  /** @param {string} room @param {string} slot @param {(card: Card) => void} fit */
  constructor(room, slot, fit) {
    this.link = new ControlLink(room, slot);
    this.name = slot;
    this.isTelling = false;
    /** The profile that this page knows to be in use. @type {any} */
    this.profile = null;
    const id = `source-${slot}`;
    this.title = element("h3", { id: `${id}-name` });
    this.state = element("span", { class: "badge" }, element("span", { class: "dot", "aria-hidden": "true" }), element("span"));
    this.about = element("p", { class: "quiet small-text" });
    this.groups = element("ul", { class: "groups", "aria-label": "Parts of the face" });
    this.answer = element("p", { class: "quiet small-text", role: "status" });
    this.answer.hidden = true;
    this.buttons = [
      element("button", { class: "small", "data-do": "calibrate", title: "The face of this moment is at rest", onclick: () => this.#ask({ type: "calibrate" }, "calibrating", "Hold the face at rest: it is taken as neutral.") }, "Neutral"),
      element("button", { class: "small", "data-do": "recentre", title: "The head's pose of this moment is straight ahead", onclick: () => this.#ask({ type: "recentre" }, "recentred", "This is straight ahead now.") }, "Re-centre"),
      element("button", { class: "small", "data-do": "fit", title: "Eight faces, twenty seconds", onclick: () => fit(this) }, "Fit…"),
    ];
    const body = element("div");
    this.settings = new Settings(body, (values) => this.#tell(values), { prefix: `${id}-` });
    this.profiles = element("select", { "aria-label": "Profile", onchange: () => this.#choose(this.profiles.value) });
    this.profileText = element("p", { class: "quiet small-text", role: "status" });
    this.file = element("input", { type: "file", accept: "application/json,.json", hidden: true, onchange: () => this.#load() });
    this.save = element("button", { class: "small", disabled: true, onclick: () => this.#save() }, "Save as a file");
    this.details = element("details", { ontoggle: () => this.#opened() },
      element("summary", {}, "Settings and profile"),
      body,
      element("h2", {}, "Profile"),
      this.profileText,
      element("div", { class: "actions" }, this.profiles),
      element("div", { class: "actions" },
        element("button", { class: "small", onclick: () => this.file.click() }, "Load a file…"), this.save, this.file));
    this.item = element("li", { class: "source", "data-slot": slot, "aria-labelledby": `${id}-name` },
      element("div", { class: "source-head" }, this.title, this.state),
      this.about, this.groups,
      element("div", { class: "actions" }, ...this.buttons),
      this.answer, this.details);
  }

  /** @param {Listing} source */
  show({ slot, source, priority, groups, live, drives }) {
    const name = source || slot;
    // Another sender in the slot: what is known of the first one's is not this one's.
    if (name !== this.name) {
      this.name = name;
      this.profile = null;
      if (this.details.open) this.#opened();
    }
    say(this.title, name);
    say(this.about, `slot ${slot} · priority ${priority}`);
    this.state.dataset.kind = live ? "live" : "silent";
    say(this.state.lastElementChild, live ? "Live" : "Silent");
    const text = `${groups.join()} ${drives.join()}`;
    if (text !== this.groups.dataset.shown) {
      this.groups.dataset.shown = text;
      this.groups.replaceChildren(...GROUPS.filter(([group]) => groups.includes(group)).map(([group, label]) => {
        const isDriving = drives.includes(group);
        return element("li", { class: isDriving ? "drives" : "", "data-group": group }, label,
          element("span", { class: "visually-hidden" }, isDriving ? ": driven" : ": not driven"));
      }));
    }
    for (const button of this.buttons) button.disabled = !live;
    // How much the smoothing delays goes with how fast the face moves.
    if (live && this.details.open && !this.isTelling && !this.settings.isBusy()) this.#tell({});
  }

  /** @param {string} text @param {boolean} isBad */
  #say(text, isBad = false) {
    say(this.answer, text);
    this.answer.classList.toggle("note", isBad);
    this.answer.classList.toggle("quiet", !isBad);
    this.answer.hidden = !text;
  }

  /** @param {Record<string, any>} message @param {string} type of the answer @param {string} done */
  async #ask(message, type, done) {
    try {
      await this.link.ask(message, answerOf(type));
      this.#say(done);
    } catch (error) {
      this.#say(`Not done: ${messageOf(error)}.`, true);
    }
  }

  // Settings.

  #opened() {
    if (!this.details.open) return;
    // A change of nothing is answered with what is in use.
    this.#tell({});
    this.#listProfiles();
    this.#showProfile();
  }

  /** @param {Record<string, any>} values */
  async #tell(values) {
    this.isTelling = true;
    try {
      const answer = await this.link.ask({ type: "settings", ...values }, answerOf("settings"));
      if (!this.settings.isBusy()) this.settings.take(answer);
      this.settings.setDelays(answer.added_delay);
      this.settings.say("");
    } catch (error) {
      this.settings.say(`The source did not take them: ${messageOf(error)}.`);
    }
    this.isTelling = false;
  }

  /** @param {Record<string, any>} values */
  change(values) {
    this.#tell(values);
  }

  // The profile.

  async #listProfiles() {
    let names = [];
    try {
      names = (await listProfiles(this.link.room)).map(({ name }) => name);
    } catch {
      // Files serve without a list.
    }
    this.profiles.replaceChildren(
      new Option(names.length ? "Choose a profile the server keeps…" : "The server keeps no profiles", ""), ...names.map((name) => new Option(name, name)));
    this.profiles.disabled = !names.length;
    this.profiles.value = names.includes(this.profile?.name) ? this.profile.name : "";
  }

  #showProfile() {
    say(this.profileText, this.profile
      ? `In use: ${this.profile.name || "a profile without a name"}.`
      : "“Fit…” makes one. A source that was fitted before has its newest one that the server keeps.");
    this.save.disabled = !this.profile;
  }

  /** What a fit ended with. @param {any} answer */
  fitted({ profile, kept }) {
    this.#use(profile);
    if (this.details.open) this.#listProfiles();
    return kept ? `The profile is in use, and the server keeps it as “${profile.name}”.` : "The profile is in use. Save it as a file to keep it.";
  }

  /** @param {any} profile */
  #use(profile) {
    this.profile = profile;
    this.#showProfile();
    this.settings.take(profile.settings ?? {});
    if (this.details.open) this.#tell({});
  }

  /** @param {string | any} profile its name or itself */
  async #choose(profile) {
    if (!profile) return;
    try {
      const answer = await this.link.ask({ type: "profile", profile }, answerOf("profile"));
      this.#use(answer.profile);
      if (answer.warnings.length) say(this.profileText, `In use, but: ${answer.warnings.join("; ")}.`);
    } catch (error) {
      say(this.profileText, `Not taken: ${messageOf(error)}.`);
    }
  }

  async #load() {
    const file = this.file.files?.[0];
    this.file.value = "";
    if (!file) return;
    try {
      await this.#choose(await readProfile(file));
    } catch (error) {
      say(this.profileText, `Not loaded: ${messageOf(error)}.`);
    }
  }

  #save() {
    // With the settings as they are by now.
    saveProfile({ ...this.profile, settings: this.settings.toJson() });
  }
}
