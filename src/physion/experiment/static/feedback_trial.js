/**
 * jsPsych plugin: feedback on a familiarization answer: the flashing map of agent and patient once
 * more, then the full movie. The participant can continue when the movie has ended.
 * @module feedback_trial
 */

import { button, el } from "./dom.js";
import { MovieFailed, Screen } from "./screen.js";

const { ParameterType } = window.jsPsychModule;

const info = {
  name: "physion-feedback",
  version: "1.0.0",
  parameters: {
    /** Returns a promise of the server's `Feedback`, which follows the storing of the answer. */
    feedback: { type: ParameterType.FUNCTION, default: undefined },
    /** Takes the path of the full movie; returns a promise of the `Addresses` of movie and map. */
    load: { type: ParameterType.FUNCTION, default: undefined },
    /** Size and rate of the movie: a `TrialMedia`. */
    media: { type: ParameterType.OBJECT, default: undefined },
    /** Duration of the first frame with the flashing map. */
    cue_ms: { type: ParameterType.INT, default: 2000 },
    /** On-off cycles of the map per second. */
    flash_hz: { type: ParameterType.FLOAT, default: 2 },
    /** Texts by name: prompt, waiting, correct, incorrect, contact, no_contact, next, trouble. */
    words: { type: ParameterType.OBJECT, default: undefined },
    /** Called with kind and data of an event. */
    log: { type: ParameterType.FUNCTION, default: () => {} },
    /** Returns the AbortSignal that ends the trial. */
    signal: { type: ParameterType.FUNCTION, default: () => new AbortController().signal },
  },
  data: {
    correct: { type: ParameterType.BOOL },
    contact: { type: ParameterType.BOOL },
    frames_shown: { type: ParameterType.INT },
  },
};

/** The plugin class. */
export class FeedbackTrial {
  static info = info;

  /** @param {any} jsPsych */
  constructor(jsPsych) {
    this.jsPsych = jsPsych;
  }

  /**
   * Run the trial.
   * @param {HTMLElement} display
   * @param {any} trial The parameters.
   * @param {() => void} on_load
   */
  async trial(display, trial, on_load) {
    const { words } = trial;
    const signal = trial.signal();
    const screen = new Screen(trial.media, signal);
    const verdict = el("span", { class: "verdict", role: "status" }, words.waiting);
    const outcome = el("span", {});
    const next = button(words.next, () => {}, { disabled: true });
    const row = el("div", { class: "answers" }, next);
    // The movie is at the same position as in the trial.
    display.replaceChildren(
      el(
        "div",
        { class: "trial has-verdict" },
        el("h1", { class: "unseen" }, words.prompt),
        screen.element,
        row,
        el("p", { class: "prompt" }, verdict, " ", outcome),
      ),
    );
    on_load();
    try {
      return await feedbackOn(screen, { verdict, outcome, next }, trial, signal);
    } finally {
      screen.release();
    }
  }
}

/** Show the verdict, map and full movie, and wait until the participant continues. */
async function feedbackOn(screen, { verdict, outcome, next }, trial, signal) {
  const { words } = trial;
  const feedback = await trial.feedback();
  const addresses = await trial.load(feedback.movie);
  verdict.textContent = feedback.correct ? words.correct : words.incorrect;
  verdict.classList.add(feedback.correct ? "verdict-correct" : "verdict-incorrect");
  outcome.textContent = feedback.contact ? words.contact : words.no_contact;
  try {
    await playOnce(screen, addresses, trial, outcome);
  } finally {
    URL.revokeObjectURL(addresses.movie);
  }
  const frames_shown = screen.record().shown;
  next.disabled = false;
  next.focus();
  await new Promise((resolve, reject) => {
    next.addEventListener("click", resolve);
    signal.addEventListener("abort", () => reject(signal.reason));
  });
  return { correct: feedback.correct, contact: feedback.contact, frames_shown };
}

/**
 * Flash the map and play the movie; on failure show a message and retry twice, then let the
 * participant continue.
 */
async function playOnce(screen, addresses, trial, outcome) {
  const text = outcome.textContent;
  for (let attempt = 1; attempt <= 3; attempt++) {
    try {
      await screen.load(addresses);
      await screen.flash({ ms: trial.cue_ms, hz: trial.flash_hz });
      await screen.play({ hide: false });
      outcome.textContent = text;
      return;
    } catch (error) {
      if (!(error instanceof MovieFailed)) throw error;
      trial.log("feedback_movie_failed", { attempt, reason: error.message });
      outcome.textContent = trial.words.trouble;
    }
  }
}
