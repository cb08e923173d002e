/**
 * A modal question. The page below keeps running but takes no input.
 * @module dialog
 */

import { el } from "./dom.js";
import { focusHeading } from "./page_trial.js";

/** Event of the document when a question was opened or closed. */
export const ASKED = "physion:asked";

/**
 * Show a question and wait for the answer.
 * @param {import("./pages.js").Render} render Fills the dialog; its `done` gives the answer.
 * @param {AbortSignal} signal Closes the dialog without an answer.
 * @returns {Promise<any>} The answer; null if the dialog was closed without one (Escape).
 */
export function ask(render, signal) {
  const page = el("div", { class: "page" });
  const dialog = el("dialog", { class: "dialog" }, page);
  return new Promise((resolve) => {
    let answer = null;
    const done = (values = {}) => {
      answer = values;
      dialog.close();
    };
    dialog.addEventListener("close", () => {
      dialog.remove();
      document.dispatchEvent(new Event(ASKED));
      resolve(answer);
    });
    signal.addEventListener("abort", () => dialog.close());
    render(page, done, signal);
    const heading = page.querySelector("h1");
    heading.id = "question";
    dialog.setAttribute("aria-labelledby", heading.id);
    document.body.append(dialog);
    dialog.showModal();
    document.dispatchEvent(new Event(ASKED));
    focusHeading(page);
  });
}

/** Return whether a question is open; keys are then for the dialog. @returns {boolean} */
export const isAsked = () => document.querySelector("dialog[open]") !== null;
