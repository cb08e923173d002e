/**
 * A question above what runs, which goes on below and takes no input meanwhile.
 * @module dialog
 */

import { el } from "./dom.js";
import { focusHeading } from "./page_trial.js";

/**
 * @param {import("./pages.js").Render} render Fills the question; its `done` answers it.
 * @param {AbortSignal} signal Takes the question back.
 * @returns {Promise<any>} The answer; null where it was closed without one (Escape).
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
      resolve(answer);
    });
    signal.addEventListener("abort", () => dialog.close());
    render(page, done, signal);
    const heading = page.querySelector("h1");
    heading.id = "question";
    dialog.setAttribute("aria-labelledby", heading.id);
    document.body.append(dialog);
    dialog.showModal();
    focusHeading(page);
  });
}

/** Is anything asked? Keys are for the question then. @returns {boolean} */
export const isAsked = () => document.querySelector("dialog[open]") !== null;
