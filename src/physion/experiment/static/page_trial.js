/**
 * A jsPsych plugin: one page with words and controls, between the trials.
 * @module page_trial
 */

const { ParameterType } = window.jsPsychModule;

const LATE_MS = 500;

const info = {
  name: "physion-page",
  version: "1.0.0",
  parameters: {
    /**
     * Called with an empty element, which it fills, the function that ends the page with its data,
     * and the AbortSignal that ends it without.
     */
    render: { type: ParameterType.FUNCTION, default: undefined },
    /** Gives the AbortSignal that ends the page. */
    signal: { type: ParameterType.FUNCTION, default: () => new AbortController().signal },
  },
  data: {
    /** What was filled in, by name. */
    values: { type: ParameterType.OBJECT },
  },
};

export class PageTrial {
  static info = info;

  /** @param {any} jsPsych */
  constructor(jsPsych) {
    this.jsPsych = jsPsych;
  }

  /** @param {HTMLElement} display @param {any} trial @param {() => void} on_load */
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
 * Fill a place with a page and put the focus on its heading, so that readers begin there.
 * @param {HTMLElement} place
 * @param {(page: HTMLElement) => void} render
 */
export function showPage(place, render) {
  const page = document.createElement("div");
  page.className = "page";
  render(page);
  place.replaceChildren(page);
  window.scrollTo(0, 0);
  focusHeading(page);
}

/**
 * What is awaited. Where it takes long, an empty place says so meanwhile.
 * @template T
 * @param {HTMLElement} place
 * @param {(page: HTMLElement) => void} render
 * @param {Promise<T>} awaited
 * @returns {Promise<T>}
 */
export async function patiently(place, render, awaited) {
  const say = () => place.querySelector("h1") ?? showPage(place, render);
  const timer = setTimeout(say, LATE_MS);
  try {
    return await awaited;
  } finally {
    clearTimeout(timer);
  }
}

/** @param {HTMLElement} page */
export function focusHeading(page) {
  const heading = page.querySelector("h1");
  if (!heading) return;
  heading.tabIndex = -1;
  heading.focus({ preventScroll: true });
}
