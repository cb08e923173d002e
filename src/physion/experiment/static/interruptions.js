/**
 * Interruptions of a showing: the page is hidden, a dialog is open, or the window is too small.
 * @module interruptions
 */

import { ASKED, isAsked } from "./dialog.js";
import { pageVisible } from "./dom.js";

/** Raised when a showing is interrupted. `reason`: hidden, dialog or window. */
export class Interrupted extends Error {
  /** @param {"hidden"|"dialog"|"window"} reason */
  constructor(reason) {
    super(`interrupted: ${reason}`);
    this.reason = reason;
  }
}

/**
 * Wait until a showing can begin: the page is visible, no dialog open and the window large enough.
 * @param {() => boolean} fits Returns whether the window is large enough.
 * @param {() => Promise<any>} enlarge Shows a page until it is.
 * @param {AbortSignal} signal
 */
export async function undisturbed(fits, enlarge, signal) {
  while (document.hidden || isAsked() || !fits()) {
    signal.throwIfAborted();
    await pageVisible();
    if (isAsked()) await dialogClosed(signal);
    else if (!fits()) await enlarge();
  }
  signal.throwIfAborted();
}

/** Wait until the open dialog is closed. @param {AbortSignal} signal @returns {Promise<void>} */
function dialogClosed(signal) {
  return new Promise((resolve, reject) => {
    document.addEventListener(ASKED, () => resolve(), { once: true, signal });
    signal.addEventListener("abort", () => reject(signal.reason), { once: true });
  });
}

/**
 * Create a signal that follows another one and, until `end` is called, notices interruptions.
 * @param {AbortSignal} signal
 * @param {() => boolean} fits
 * @param {boolean} repeat Whether an interruption also aborts the created signal.
 */
export function watchInterruptions(signal, fits, repeat) {
  const seen = new AbortController();
  const over = new AbortController();
  const options = { signal: over.signal };
  /** @type {Array<"hidden"|"dialog"|"window">} */
  const reasons = [];
  const note = (happened, reason) => {
    if (!happened) return;
    if (!reasons.includes(reason)) reasons.push(reason);
    if (repeat) seen.abort(new Interrupted(reason));
  };
  const stop = () => seen.abort(signal.reason);
  signal.addEventListener("abort", stop, options);
  document.addEventListener("visibilitychange", () => note(document.hidden, "hidden"), options);
  document.addEventListener(ASKED, () => note(isAsked(), "dialog"), options);
  window.addEventListener("resize", () => note(!fits(), "window"), options);
  if (signal.aborted) stop();
  return { signal: seen.signal, end: () => over.abort(), reasons };
}
