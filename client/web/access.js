// The token that lets this page in, where the server wants one. It comes behind the address's `#`, which browsers send nowhere,
// or from the person; it stays with this tab, and travels in a socket's subprotocol or a header, never in an address.

import { SUBPROTOCOL, byId, element } from "./util.js";

/** Where the tab keeps it. */
const KEY = "rhytid.token";
/** Before a token among the subprotocols. */
const TOKEN_PROTOCOL = "rhytid.token.";
/** Three parts of base64url between dots, and no longer than the server takes. */
const TOKEN = /^[\w-]+\.[\w-]+\.[\w-]+$/;
const MOST_TOKEN = 4096;
/** Milliseconds that the server may take to say why it refused. */
const PATIENCE = 3000;

/** Where the tab's storage is forbidden it is kept here, until the page is left. */
let kept = "";
/** @type {Set<() => void>} */
const waiting = new Set();

/** @param {string} text */
export const isToken = (text) => text.length <= MOST_TOKEN && TOKEN.test(text);

/**
 * An address's fragment without its token, and the token.
 * @param {string} hash with its `#`, or empty
 * @returns {{token: string, rest: string}} the token is empty where there is none
 */
export function splitFragment(hash) {
  const parts = hash.replace(/^#/, "").split("&").filter(Boolean);
  const token = parts.find((part) => part.startsWith("token="))?.slice("token=".length) ?? "";
  const others = parts.filter((part) => !part.startsWith("token=")).join("&");
  return { token: isToken(token) ? token : "", rest: others && `#${others}` };
}

/** @returns {string} empty where there is none */
export function token() {
  try {
    return sessionStorage.getItem(KEY) ?? kept;
  } catch {
    return kept;
  }
}

/** Keeps a token, and tells what waits for one. @param {string} text */
export function setToken(text) {
  kept = text;
  try {
    sessionStorage.setItem(KEY, text);
  } catch {
    // It is kept until the page is left.
  }
  tell();
}

function tell() {
  for (const told of [...waiting]) told();
}

/** Takes the token out of this page's address: whoever copies the address, or looks at the history, does not get it. */
export function takeTokenOfAddress() {
  if (!location.hash.includes("token=")) return;
  const { token: given, rest } = splitFragment(location.hash);
  history.replaceState(history.state, "", location.pathname + location.search + rest);
  if (given) setToken(given);
}

/** Nobody else can read what goes to the server. */
const mayCarrySecrets = () => location.protocol === "https:" || ["localhost", "127.0.0.1", "[::1]"].includes(location.hostname);

const isSent = () => Boolean(token()) && mayCarrySecrets();

/** The subprotocols that a socket offers. @returns {string[]} */
export const protocols = () => (isSent() ? [SUBPROTOCOL, TOKEN_PROTOCOL + token()] : [SUBPROTOCOL]);

/** The headers of a request. @returns {Record<string, string>} */
export const headers = () => (isSent() ? { Authorization: `Bearer ${token()}` } : {});

/**
 * What a token says of itself; only the server can tell whether it is true.
 * @param {string} text
 * @returns {{role: string, rooms: string[], exp: number} | null} `exp` in seconds since 1970
 */
export function claims(text) {
  if (!isToken(text)) return null;
  try {
    const said = JSON.parse(atob(text.split(".")[1].replaceAll("-", "+").replaceAll("_", "/")));
    return typeof said.role === "string" && Array.isArray(said.rooms) && Number.isFinite(said.exp) ? said : null;
  } catch {
    return null;
  }
}

/** The token does not do, or there is none. @param {string} code of an error */
export const isAboutToken = (code) => code.startsWith("token_");

/**
 * Why the server does not let this page in: a browser does not tell why a socket was refused.
 * @param {"view" | "publish"} role @param {string} room
 * @returns {Promise<{code: string, message: string} | null>} null where it is for another reason
 */
export async function refusal(role, room) {
  try {
    const answer = await fetch(`/api/access?role=${role}&room=${room}`, { headers: headers(), cache: "no-store", signal: AbortSignal.timeout(PATIENCE) });
    if (answer.status !== 401 && answer.status !== 403) return null;
    const { code, message } = await answer.json();
    if (!isAboutToken(code)) return null;
    const words = {
      token_missing: token() ? "A token travels over https only: open this page by its https address." : "This server lets in who has a token.",
      token_bad: "The token is none of this server's.",
      token_expired: "The token's time is over.",
      token_role: role === "publish" ? "The token is for watching, not for publishing." : "The token is for something else.",
      token_room: `The token is for other rooms than ${room}.`,
    };
    return { code, message: words[/** @type {keyof typeof words} */ (code)] ?? message };
  } catch {
    return null;
  }
}

/**
 * Calls `told` at every new token, also at one that was given in a frame of this page.
 * @param {() => void} told
 * @returns {() => void} ends it
 */
export function onToken(told) {
  waiting.add(told);
  return () => waiting.delete(told);
}

/** Asks the person for a token; nothing comes of it where they have none. @param {string} why a sentence */
export function askForToken(why) {
  // In a browser source nobody could answer.
  if (document.body.classList.contains("bare")) return;
  /** @type {HTMLDialogElement | null} */
  let dialog = document.querySelector("#access");
  if (!dialog) {
    const input = element("input", {
      id: "access-input", type: "password", autocomplete: "off", spellcheck: false, placeholder: "Token", "aria-label": "Token", "aria-describedby": "access-why",
    });
    const take = (/** @type {SubmitEvent} */ event) => {
      event.preventDefault();
      const given = input.value.trim();
      if (!isToken(given)) {
        byId("access-why").textContent = "That is no token: it has three parts with dots between them.";
        return;
      }
      input.value = "";
      dialog?.close();
      setToken(given);
    };
    const made = element("dialog", { id: "access", "aria-labelledby": "access-title" },
      element("div", { class: "dialog-head" },
        element("h2", { id: "access-title" }, "Who are you?"),
        element("button", { class: "small", onclick: () => dialog?.close() }, "Not now")),
      element("p", { id: "access-why", class: "quiet", role: "status" }),
      element("form", { class: "copy", onsubmit: take }, input, element("button", { class: "primary" }, "Go in")));
    document.body.append(made);
    dialog = made;
  }
  byId("access-why").textContent = `${why} Whoever runs the server can give you one.`;
  if (!dialog?.open) dialog?.showModal();
}

if (typeof window !== "undefined") {
  takeTokenOfAddress();
  addEventListener("hashchange", takeTokenOfAddress);
  // The frame of the camera page shares the tab's storage.
  addEventListener("storage", ({ key }) => {
    if (key === KEY) tell();
  });
}
