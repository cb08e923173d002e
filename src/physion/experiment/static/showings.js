/**
 * Announcement of each showing of a trial, which the server counts and from which it knows when the
 * movie can have been seen.
 * @module showings
 */

import { Refused } from "./api.js";
import { newKey } from "./random_key.js";

const DAY_MS = 86_400_000;

/**
 * A showing. `began`: when it began (see `present`); `stored`: whether the server has acknowledged
 * it.
 * @typedef {{key: string, phase: string, trial: number, began: number, stored: boolean}} Announced
 */

/**
 * Return the time in ms since 1970. Within a page it only grows, even if the machine's clock is
 * set; `performance.now` starts at 0 again after a reload, which stored showings outlive.
 * @returns {number}
 */
function present() {
  return performance.timeOrigin + performance.now();
}

/**
 * Return the showing that begins now.
 * @param {string} phase @param {number} trial
 * @returns {Announced}
 */
export function newShowing(phase, trial) {
  return { key: newKey(), phase, trial, began: present(), stored: false };
}

/**
 * Send a showing until the server has it; it is counted once. Returns also if it was refused, since
 * the answer is then refused too.
 * @param {import("./api.js").Api} api
 * @param {Announced} showing
 * @param {import("./api.js").Options} [options]
 */
export async function announce(api, showing, options = {}) {
  if (showing.stored) return;
  const { key, phase, trial, began } = showing;
  const ago = () => Math.min(Math.max(present() - began, 0), DAY_MS);
  const body = () => ({ key, phase, trial, ago_ms: ago() });
  try {
    await api.post("/api/showings", body, { ...options, expects: "showings" });
    showing.stored = true;
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
  }
}
