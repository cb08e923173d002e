/**
 * The session that this browser remembers: its token, a hash of the participant's id, and a random
 * key for participants without an id. Ids themselves are not stored.
 * @module remembered
 */

import { keep, newKey, outlivesPage, recall } from "./storage.js";

/**
 * A remembered session. `who`: see `whoOf`; `link`: query of the other URL parameters, for the next
 * person on this computer.
 * @typedef {{token: string, who: string|null, link: string}} Remembered
 */

/** Return the remembered session. @returns {Remembered|null} */
export function remembered() {
  const session = recall("session");
  return session?.token ? session : null;
}

/** Remember a session. @param {Remembered} session */
export function remember(session) {
  keep("session", session);
}

/**
 * Return whether a reload would find the session again.
 * @param {string} token
 * @returns {boolean}
 */
export const isFoundAgain = (token) => outlivesPage("session") && remembered()?.token === token;

/** Forget only the session. */
export function forgetSession() {
  keep("session", null);
}

/** Forget all data of a person. @param {import("./messages.js").PublicStudy} study */
export function forgetPerson(study) {
  for (const name of ["session", "language", "feedback", visitName(study)]) keep(name, null);
}

/**
 * Remember a practice answer until its feedback was seen.
 * @param {string} session Reference of the session.
 * @param {import("./messages.js").Answer} answer
 */
export function rememberFeedback(session, answer) {
  keep("feedback", { session, answer });
}

/** Forget the practice answer whose feedback was due. */
export function forgetFeedback() {
  keep("feedback", null);
}

/**
 * Return the last practice answer of the session if its feedback was not seen, as when the page was
 * reloaded meanwhile; else null.
 * @param {import("./messages.js").SessionState} state
 * @returns {import("./messages.js").Answer|null}
 */
export function dueFeedback(state) {
  const due = recall("feedback");
  if (due?.session !== state.reference || !due.answer) return null;
  const answered = state.stage === "ready" ? state.trials.familiarization : state.trial;
  const practises = state.stage === "familiarization" || state.stage === "ready";
  const repeats = state.practice_repeats > 0 && due.answer.trial >= answered;
  return practises && (repeats || answered === due.answer.trial + 1) ? due.answer : null;
}

/**
 * Return the random key that binds a person's session to this browser; draw and store it on the
 * first call.
 * @param {import("./messages.js").PublicStudy} study
 * @param {string|null} who The person: see `whoOf`.
 * @returns {string}
 */
export function visitKey(study, who) {
  const name = visitName(study) + (who === null ? "" : `:${who}`);
  const known = recall(name) ?? window.history.state?.[name];
  if (typeof known === "string") return known;
  const key = newKey();
  keep(name, key);
  // Without storage, the entry of the browser's history outlives a reload.
  if (!outlivesPage(name)) window.history.replaceState({ [name]: key }, "");
  return key;
}

const visitName = (study) => `visit:${study.title}`;

/**
 * Return a hash that identifies the person of a URL, or null if the URL identifies nobody.
 * @param {import("./messages.js").Enter} enter
 * @returns {Promise<string|null>}
 */
export async function whoOf({ source, id, pass }) {
  if (!id && (!pass || isOfStudy(pass))) return null;
  const bytes = new TextEncoder().encode(JSON.stringify([source, id ?? null, pass ?? null]));
  // Browsers lack it without HTTPS.
  if (!crypto.subtle) return plainHash(bytes);
  const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", bytes));
  return Array.from(digest, hex).join("");
}

/** Return whether a link's key is signed for all people. @param {string} pass @returns {boolean} */
export const isOfStudy = (pass) => pass.startsWith("study-");

const hex = (byte) => byte.toString(16).padStart(2, "0");

/** 64-bit FNV-1a hash: distinguishes ids, but is not cryptographic. @param {Uint8Array} bytes */
function plainHash(bytes) {
  let hash = 0xcbf29ce484222325n;
  for (const byte of bytes) hash = BigInt.asUintN(64, (hash ^ BigInt(byte)) * 0x100000001b3n);
  return hash.toString(16).padStart(16, "0");
}
