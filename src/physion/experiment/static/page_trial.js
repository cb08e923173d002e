/**
 * jsPsych plugin: one page with text and controls, between the trials.
 * @module page_trial
 */

import { el } from "./dom.js";

const { ParameterType } = window.jsPsychModule;

const LATE_MS = 500;

const info = {
  name: "physion-page",
  version: "1.0.0",
  parameters: {
    /**
     * A `Render`: called with an empty element to fill, a function that ends the page with its
     * data, and an AbortSignal that ends it without.
     */
    render: { type: ParameterType.FUNCTION, default: undefined },
    /** Returns the AbortSignal that ends the page. */
    signal: { type: ParameterType.FUNCTION, default: () => new AbortController().signal },
  },
  data: {
    /** Values of the form by name. */
    values: { type: ParameterType.OBJECT },
  },
};

/** The plugin class. */
export class PageTrial {
  static info = info;

  /** @param {any} jsPsych */
  constructor(jsPsych) {
    this.jsPsych = jsPsych;
  }

  /**
   * Run the page.
   * @param {HTMLElement} display
   * @param {any} trial The parameters.
   * @param {() => void} on_load
   */
  async trial(display, trial, on_load) {
    const over = new AbortController();
    const signal = trial.signal();
    const stop = () => over.abort(signal.reason);
    signal.addEventListener("abort", stop, { once: true });
    try {
      const values = await new Promise((resolve, reject) => {
        over.signal.addEventListener("abort", () => reject(signal.reason), { once: true });
        showPage(display, (page) => trial.render(page, resolve, over.signal));
        on_load();
      });
      return { values: values ?? {} };
    } finally {
      signal.removeEventListener("abort", stop);
      over.abort();
    }
  }
}

/**
 * Show a page in a container and focus its heading, where screen readers begin.
 * @param {HTMLElement} container
 * @param {(page: HTMLElement) => void} render
 */
export function showPage(container, render) {
  const page = document.createElement("div");
  page.className = "page";
  render(page);
  container.replaceChildren(page);
  window.scrollTo(0, 0);
  focusHeading(page);
}

/**
 * Await a promise; if it takes long and the container is empty, show a page meanwhile.
 * @template T
 * @param {HTMLElement} container
 * @param {(page: HTMLElement) => void} render
 * @param {Promise<T>} awaited
 * @returns {Promise<T>}
 */
export async function patiently(container, render, awaited) {
  const show = () => container.querySelector("h1") ?? showPage(container, render);
  const timer = setTimeout(show, LATE_MS);
  try {
    return await awaited;
  } finally {
    clearTimeout(timer);
  }
}

/** Focus the heading of a page. @param {HTMLElement} page */
export function focusHeading(page) {
  const heading = page.querySelector("h1");
  if (!heading) return;
  heading.tabIndex = -1;
  heading.focus({ preventScroll: true });
}

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
