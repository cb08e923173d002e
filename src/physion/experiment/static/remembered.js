/**
 * What this browser knows of who takes part in it: the token of the session, whose it is, and a
 * word for who comes without an id. No id is kept, only what it can be recognised by.
 * @module remembered
 */

import { newKey } from "./random_key.js";
import { keep, outlivesPage, recall } from "./storage.js";

/**
 * @typedef {{token: string, who: string|null, link: string}} Remembered `who`: see `whoOf`; `link`:
 * what the address named besides, as a query, for the next person.
 */

/** @returns {Remembered|null} */
export function remembered() {
  const found = recall("session");
  return found?.token ? found : null;
}

/** @param {Remembered} session */
export function remember(session) {
  keep("session", session);
}

/** Does a reload find the session of this token? @param {string} token @returns {boolean} */
export const isFoundAgain = (token) => outlivesPage("session") && remembered()?.token === token;

/** Forget the session that is remembered, and no more. */
export function forgetSession() {
  keep("session", null);
}

/** Forget all that belongs to one person. @param {any} study `PublicStudy` */
export function forgetPerson(study) {
  for (const name of ["session", "language", visitName(study)]) keep(name, null);
}

/**
 * The word for whoever comes without an id, made when it is first asked for.
 * @param {any} study `PublicStudy` @returns {string}
 */
export function visitWord(study) {
  const name = visitName(study);
  const known = recall(name);
  if (typeof known === "string") return known;
  const made = newKey();
  keep(name, made);
  return made;
}

const visitName = (study) => `visit:${study.title}`;

/**
 * What tells whether an address is of the same person; null where it names nobody.
 * @param {any} enter The beginning of an `Enter`. @returns {Promise<string|null>}
 */
export async function whoOf({ source, id, pass }) {
  if (!id && !pass) return null;
  const bytes = new TextEncoder().encode(JSON.stringify([source, id ?? null, pass ?? null]));
  // Without https browsers lack it.
  if (!crypto.subtle) return plainHash(bytes);
  const digest = new Uint8Array(await crypto.subtle.digest("SHA-256", bytes));
  return Array.from(digest, hex).join("");
}

const hex = (byte) => byte.toString(16).padStart(2, "0");

/** FNV-1a with 64 bits: tells ids apart, though it hides them less well. */
function plainHash(bytes) {
  let hash = 0xcbf29ce484222325n;
  for (const byte of bytes) hash = BigInt.asUintN(64, (hash ^ BigInt(byte)) * 0x100000001b3n);
  return hash.toString(16).padStart(16, "0");
}
