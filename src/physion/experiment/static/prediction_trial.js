/**
 * jsPsych plugin: one trial of object contact prediction. Sequence: fixation cross; first frame
 * with the flashing map of agent and patient; the observed movie; then, with the movie hidden, YES
 * or NO. If the showing is interrupted before the movie has ended, the trial is shown again from the
 * start, or its answer is void.
 * @module prediction_trial
 */

import { button, el, nextFrame, pageVisible } from "./dom.js";
import { ASKED, isAsked } from "./page_trial.js";
import { MovieFailed, round, Screen } from "./screen.js";

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

const { ParameterType } = window.jsPsychModule;
const ATTEMPTS = 3;
/** Most repetitions of a trial because it was interrupted; afterwards its answer is void. */
const REPEATS = 5;
const DAY_MS = 86_400_000;
/** Largest number of recorded times of each kind, to limit the size of an answer. */
const MOST_NOTED = 100;

const info = {
  name: "physion-prediction",
  version: "1.0.0",
  parameters: {
    /** Takes the number of failures so far; returns a promise of the `Addresses`. */
    load: { type: ParameterType.FUNCTION, default: undefined },
    /** Size, rate and number of frames of the movie: a `TrialMedia`. */
    media: { type: ParameterType.OBJECT, default: undefined },
    fixation_ms: { type: ParameterType.INT, default: 1000 },
    /** Duration of the first frame with the flashing map. */
    cue_ms: { type: ParameterType.INT, default: 2000 },
    /** On-off cycles of the map per second. */
    flash_hz: { type: ParameterType.FLOAT, default: 2 },
    /** Responses from left to right. */
    choices: { type: ParameterType.STRING, array: true, default: ["yes", "no"] },
    /** Keys from left to right. */
    keys: { type: ParameterType.KEYS, array: true, default: ["f", "j"] },
    /** Texts by name: prompt, yes, no, trouble, retry. */
    words: { type: ParameterType.OBJECT, default: undefined },
    /** What the prompt says after the movie of an attention check; empty for other trials. */
    instruction: { type: ParameterType.STRING, default: "" },
    /** How often the trial was shown before and left without an answer. */
    before: { type: ParameterType.INT, default: 0 },
    /** Whether an interrupted trial is shown again. */
    repeat: { type: ParameterType.BOOL, default: true },
    /** Returns whether the window is large enough. */
    fits: { type: ParameterType.FUNCTION, default: () => true },
    /** Shows a page while the window is too small; returns a promise of its end. */
    enlarge: { type: ParameterType.FUNCTION, default: async () => {} },
    /** Called when a showing begins. */
    began: { type: ParameterType.FUNCTION, default: () => {} },
    /** Called when the scene becomes visible. */
    shown: { type: ParameterType.FUNCTION, default: () => {} },
    /** Called with kind and data of an event. */
    log: { type: ParameterType.FUNCTION, default: () => {} },
    /** Returns the AbortSignal that ends the trial. */
    signal: { type: ParameterType.FUNCTION, default: () => new AbortController().signal },
  },
  data: {
    response: { type: ParameterType.STRING },
    /** Response time since the buttons were enabled. */
    rt_ms: { type: ParameterType.FLOAT },
    /** mouse, touch or keyboard. */
    input: { type: ParameterType.STRING },
    fixation_ms: { type: ParameterType.FLOAT },
    cue_ms: { type: ParameterType.FLOAT },
    frames_shown: { type: ParameterType.INT },
    frames_dropped: { type: ParameterType.INT },
    movie_ms: { type: ParameterType.FLOAT },
    visibility_changes: { type: ParameterType.INT },
    window_width: { type: ParameterType.INT },
    window_height: { type: ParameterType.INT },
    /** What interrupted the showing, so that the answer does not count: hidden, dialog, window. */
    void: { type: ParameterType.STRING, default: null },
    /** Times of flashes and frames in ms since the last showing began; numbers of showings. */
    details: { type: ParameterType.OBJECT },
  },
};

/** The plugin class. */
export class PredictionTrial {
  static info = info;

  /** @param {any} jsPsych */
  constructor(jsPsych) {
    this.jsPsych = jsPsych;
  }

  /**
   * Show the trial until it is answered.
   * @param {HTMLElement} display
   * @param {any} trial The parameters.
   * @param {() => void} on_load
   */
  async trial(display, trial, on_load) {
    const signal = trial.signal();
    const over = new AbortController();
    const visibility = watchVisibility(over.signal);
    let [failed, hidden, repeated] = [0, 0, 0];
    try {
      for (let attempt = 1; ; attempt++) {
        await undisturbed(trial.fits, () => trial.enlarge(display, signal), signal);
        const repeat = trial.repeat && repeated < REPEATS;
        const seen = watchInterruptions(signal, trial.fits, repeat);
        const showing = { ...trial, attempt, failed, hidden, seen };
        try {
          return await show(display, showing, signal, visibility, on_load);
        } catch (error) {
          if (signal.aborted) throw error;
          if (error instanceof Interrupted) {
            repeated += 1;
            hidden += error.reason === "hidden" ? 1 : 0;
            const { trial: number } = trial.media;
            trial.log("trial_interrupted", { trial: number, attempt, reason: error.reason });
          } else if (error instanceof MovieFailed) {
            failed += 1;
            const { trial: number } = trial.media;
            trial.log("movie_failed", { trial: number, attempt, reason: error.message });
            await showFailure(display, trial, failed);
          } else throw error;
        } finally {
          seen.end();
        }
      }
    } finally {
      over.abort();
    }
  }
}

/** Show the trial once, from the fixation cross to the answer. */
async function show(display, trial, signal, visibility, on_load) {
  const screen = new Screen(trial.media, trial.seen.signal);
  const buttons = trial.choices.map((choice, side) => answerButton(trial, choice, side));
  const cross = el("div", { class: "fixation", "aria-hidden": "true" });
  if (trial.fixation_ms > 0) screen.element.append(cross);
  display.replaceChildren(
    el(
      "div",
      { class: "trial" },
      screen.element,
      el("div", { class: "answers", role: "group", "aria-label": trial.words.prompt }, ...buttons),
      el("h1", { class: "prompt", id: "prompt" }, trial.words.prompt),
    ),
  );
  on_load();
  try {
    return await run(screen, cross, buttons, trial, signal, visibility);
  } finally {
    screen.release();
  }
}

/** Run cross, cue, movie and answer in sequence, and return the data of the trial. */
async function run(screen, cross, buttons, trial, signal, visibility) {
  const start = await nextFrame();
  trial.began();
  const loaded = trial.load(trial.failed).then((addresses) => screen.load(addresses));
  await Promise.all([loaded, reach(start + trial.fixation_ms, trial.seen.signal)]);
  const fixation_ms = round((await nextFrame()) - start);
  cross.remove();
  trial.shown();
  const cue = await screen.flash({ ms: trial.cue_ms, hz: trial.flash_hz });
  const movie = await screen.play({ hide: true });
  trial.seen.end();
  if (trial.instruction) instruct(trial.instruction);
  const answer = await answered(buttons, trial, signal);
  const frames = screen.record();
  const since = (moment) => round(moment - start);
  return {
    response: answer.response,
    rt_ms: Math.min(round(answer.rt_ms), DAY_MS),
    input: answer.input,
    fixation_ms,
    cue_ms: cue.ms,
    frames_shown: frames.shown,
    frames_dropped: frames.dropped,
    movie_ms: movie.ms,
    visibility_changes: visibility.changes.length,
    window_width: window.innerWidth,
    window_height: window.innerHeight,
    void: trial.seen.reasons[0] ?? null,
    details: {
      attempts: trial.before + trial.attempt,
      hidden: trial.hidden + (trial.seen.reasons.includes("hidden") ? 1 : 0),
      flashes: cue.changes,
      frames: frames.seen.slice(-MOST_NOTED).map(([at, frame, count]) => [since(at), frame, count]),
      play_ms: movie.startMs,
      ended_ms: since(movie.ended),
      enabled_ms: since(answer.enabled),
      visibility: visibility.changes.slice(-MOST_NOTED).map(([at, state]) => [since(at), state]),
      shown_width: Math.round(screen.element.clientWidth),
      shown_height: Math.round(screen.element.clientHeight),
    },
  };
}

/** Put the instruction of an attention check in the place of the prompt. @param {string} text */
function instruct(text) {
  const prompt = document.getElementById("prompt");
  prompt.textContent = text;
  prompt.classList.add("instruction");
}

/** Wait for the first animation frame at or after a time. */
async function reach(moment, signal) {
  while ((await nextFrame()) < moment) signal.throwIfAborted();
}

/** Create the button of a response. */
function answerButton(trial, choice, side) {
  const key = trial.keys[side];
  return el(
    "button",
    { type: "button", class: "answer", disabled: true, "data-response": choice },
    el("span", { class: "answer-word" }, trial.words[choice]),
    el("kbd", { class: "answer-key" }, key.toUpperCase()),
  );
}

/**
 * Enable the buttons in the next animation frame and wait for one of them or its key. The response
 * time is the moment of the press (mouse, finger or key). Presses that began earlier and repeated keys do
 * not count.
 * @param {HTMLButtonElement[]} buttons
 * @param {any} trial
 * @param {AbortSignal} signal
 * @returns {Promise<{response: string, rt_ms: number, input: string, enabled: number}>}
 */
function answered(buttons, trial, signal) {
  const over = new AbortController();
  const options = { signal: over.signal };
  return new Promise((resolve, reject) => {
    signal.addEventListener("abort", () => reject(signal.reason), options);
    requestAnimationFrame(() => {
      const enabled = performance.now();
      for (const each of buttons) each.disabled = false;
      const give = (event, side, input) => {
        const rt_ms = event.timeStamp - enabled;
        if (rt_ms >= 0) resolve({ response: trial.choices[side], rt_ms, input, enabled });
      };
      buttons.forEach((each, side) => {
        let down = null;
        each.addEventListener("pointerdown", (event) => (down = event), options);
        const clicked = (event) => {
          if (event.detail === 0) give(event, side, "keyboard");
          else if (down) give(down, side, inputOf(down));
        };
        each.addEventListener("click", clicked, options);
      });
      const pressed = (event) => {
        const side = sideOf(event, trial.keys);
        if (side >= 0 && !isAsked()) give(event, side, "keyboard");
      };
      document.addEventListener("keydown", pressed, options);
    });
  }).finally(() => over.abort());
}

/**
 * Return the index of the pressed key, -1 for none. On keyboards without Latin letters the physical
 * position of the key counts.
 */
function sideOf(event, keys) {
  if (event.repeat || event.ctrlKey || event.altKey || event.metaKey) return -1;
  const side = keys.indexOf(event.key.toLowerCase());
  if (side >= 0 || /^[\x20-\x7e]$/.test(event.key)) return side;
  return keys.findIndex((key) => event.code === `Key${key.toUpperCase()}`);
}

/** Return the input device of a pointer event as recorded in the answer. */
function inputOf({ pointerType }) {
  return pointerType === "touch" || pointerType === "pen" ? "touch" : "mouse";
}

/** Record the changes of the page's visibility until the signal aborts. */
function watchVisibility(signal) {
  const changes = [];
  const changed = () => changes.push([performance.now(), document.visibilityState]);
  document.addEventListener("visibilitychange", changed, { signal });
  return { changes };
}

/** Show that the movie failed; after some attempts, wait for the participant to retry. */
async function showFailure(display, trial, attempt) {
  const message = el("p", { role: "alert" }, trial.words.trouble);
  const box = el("div", { class: "page" }, message);
  display.replaceChildren(box);
  if (attempt < ATTEMPTS) return new Promise((resolve) => setTimeout(resolve, 1500));
  return new Promise((resolve) => {
    const retry = button(trial.words.retry, () => resolve(null));
    box.append(retry);
    retry.focus();
  });
}
