// Small helpers that every module of the page uses.

/**
 * The element with this id; the page's own markup must hold it.
 * @param {string} id
 * @returns {any} an element; what kind, the markup says
 */
export function byId(id) {
  const found = document.getElementById(id);
  if (!found) throw new Error(`the page has no element with the id ${id}`);
  return found;
}

/**
 * Makes an element. Properties are set as properties; `class`, `role` and names with a dash as attributes; `on…` as listeners.
 * @param {string} tag
 * @param {Record<string, any>} [properties]
 * @param {...(Node | string)} children
 * @returns {any} an element of the tag's kind
 */
export function element(tag, properties = {}, ...children) {
  /** @type {any} */
  const made = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (name === "class" || name === "role" || name === "for" || name.includes("-")) made.setAttribute(name, value);
    else made[name] = value;
  }
  made.append(...children);
  return made;
}

/** Colours a slider's track up to its thumb. @param {HTMLInputElement} input */
export function fillTrack(input) {
  const [least, most] = [Number(input.min), Number(input.max)];
  input.style.setProperty("--fill", `${(100 * (Number(input.value) - least)) / (most - least)}%`);
}

/** @param {number} value @param {number} least @param {number} most */
export const clamp = (value, least, most) => Math.min(most, Math.max(least, value));

/** Names of rooms: the server's own rule. */
export const ROOM_NAME = /^[A-Za-z0-9_-]{1,64}$/;

/**
 * The room this page's address names, `demo` where it names none or a name that cannot be one.
 * @returns {string}
 */
export function roomOfAddress() {
  const name = new URLSearchParams(location.search).get("room") ?? "";
  return ROOM_NAME.test(name) ? name : "demo";
}

/**
 * A WebSocket address on the server this page comes from.
 * @param {string} path
 */
export const socketUrl = (path) => location.origin.replace(/^http/, "ws") + path;

/** The subprotocol both sockets speak. */
export const SUBPROTOCOL = "rhytid.v1";

/** Local storage that may be forbidden: then nothing is kept. */
export const storage = {
  /** @param {string} key @returns {any} */
  read(key) {
    try {
      return JSON.parse(localStorage.getItem(`rhytid.${key}`) ?? "null");
    } catch {
      return null;
    }
  },
  /** @param {string} key @param {any} value */
  write(key, value) {
    try {
      if (value === null) localStorage.removeItem(`rhytid.${key}`);
      else localStorage.setItem(`rhytid.${key}`, JSON.stringify(value));
    } catch {
      // Private windows and full disks: the page works without.
    }
  },
};

/** Waiting times between attempts to reconnect: doubling from a quarter of a second to eight, each shortened by chance. */
export class Backoff {
  /** @param {() => number} [chance] gives numbers in `[0, 1)` */
  constructor(chance = Math.random) {
    this.chance = chance;
    this.attempts = 0;
  }

  /** Milliseconds to wait before the next attempt. Half of it is by chance, so that a thousand viewers do not come back at once. */
  next() {
    const most = Math.min(8000, 250 * 2 ** this.attempts);
    this.attempts += 1;
    return most * (0.5 + 0.5 * this.chance());
  }

  /** A connection was good: the next failure starts anew. */
  reset() {
    this.attempts = 0;
  }
}

/** Milliseconds since 1970 with fractions, comparable between this page and its frames. */
export const wallClock = () => performance.timeOrigin + performance.now();

/**
 * Copies text, also where the clipboard is only for secure pages.
 * @param {string} text
 * @returns {Promise<boolean>} whether it was copied
 */
export async function copyText(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    const area = element("textarea", { value: text, class: "offscreen" });
    document.body.append(area);
    area.select();
    const copied = document.execCommand("copy");
    area.remove();
    return copied;
  }
}

/**
 * Gives the person a file.
 * @param {string} name @param {string} text
 */
export function saveFile(name, text) {
  const url = URL.createObjectURL(new Blob([text], { type: "application/json" }));
  const link = element("a", { href: url, download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(url), 10_000);
}
