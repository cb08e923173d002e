/**
 * What the browser keeps for the participant: the token, unsent answers, the language.
 * Where the browser keeps nothing (private windows of some), memory takes its place.
 * @module storage
 */

const memory = new Map();

/** @param {string} name @returns {any} null where there is nothing or what is there is broken. */
export function recall(name) {
  try {
    const text = window.localStorage.getItem(`physion:${name}`);
    if (text !== null) return JSON.parse(text);
  } catch {
    // Neither an unreadable value nor a forbidden storage may stop a session.
  }
  return memory.get(name) ?? null;
}

/** Would it still be there after a reload? @param {string} name @returns {boolean} */
export function outlivesPage(name) {
  try {
    const text = window.localStorage.getItem(`physion:${name}`);
    return text !== null && text === JSON.stringify(recall(name));
  } catch {
    return false;
  }
}

/** @param {string} name @param {any} value null forgets it. */
export function keep(name, value) {
  memory.set(name, value);
  try {
    if (value === null) window.localStorage.removeItem(`physion:${name}`);
    else window.localStorage.setItem(`physion:${name}`, JSON.stringify(value));
  } catch {
    // Full or forbidden: memory holds it for as long as the page is open.
  }
}
