/**
 * A jsPsych plugin: one trial of object contact prediction. Fixation cross; first frame with the
 * flashing map of agent and patient; the observed movie; then, with the movie hidden, YES or NO.
 * Where the page is hidden before the movie has ended, all of it is shown again.
 * @module prediction_trial
 */

import { isAsked } from "./dialog.js";
import { button, el, nextFrame, pageVisible } from "./dom.js";
import { MovieFailed, Screen, round } from "./screen.js";

const { ParameterType } = window.jsPsychModule;
const ATTEMPTS = 3;
/** So often is a trial shown again because the page was hidden; then it goes on as it can. */
const REPEATS = 5;
const DAY_MS = 86_400_000;
/** Moments that are kept of each kind, so that an answer stays short. */
const MOST_NOTED = 100;

const info = {
  name: "physion-prediction",
  version: "1.0.0",
  parameters: {
    /** Gives the addresses of movie and map, as a promise; told how often they failed before. */
    load: { type: ParameterType.FUNCTION, default: undefined },
    /** Size and rate of the movie, its number of frames: a `TrialMedia`. */
    media: { type: ParameterType.OBJECT, default: undefined },
    fixation_ms: { type: ParameterType.INT, default: 1000 },
    /** How long the first frame is held with the flashing map above it. */
    cue_ms: { type: ParameterType.INT, default: 2000 },
    /** Whole cycles of the map in a second, on and off. */
    flash_hz: { type: ParameterType.FLOAT, default: 2 },
    /** Responses from left to right. */
    choices: { type: ParameterType.STRING, array: true, default: ["yes", "no"] },
    /** Keys from left to right. */
    keys: { type: ParameterType.KEYS, array: true, default: ["f", "j"] },
    /** Words by name: prompt, yes, no, trouble, retry. */
    words: { type: ParameterType.OBJECT, default: undefined },
    /** So often was the trial shown before, and left without an answer. */
    before: { type: ParameterType.INT, default: 0 },
    /** Called when the participant begins to see the scene. */
    shown: { type: ParameterType.FUNCTION, default: () => {} },
    /** Called with the kind and data of what went wrong. */
    log: { type: ParameterType.FUNCTION, default: () => {} },
    /** Gives the AbortSignal that ends the trial. */
    signal: { type: ParameterType.FUNCTION, default: () => new AbortController().signal },
  },
  data: {
    response: { type: ParameterType.STRING },
    /** From the moment in which the buttons were enabled. */
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
    /** Moments of flashes and frames, in ms since the last cross; how often it was shown. */
    details: { type: ParameterType.OBJECT },
  },
};

/** The page was hidden before the movie had ended. */
class PageHidden extends Error {}

export class PredictionTrial {
  static info = info;

  /** @param {any} jsPsych */
  constructor(jsPsych) {
    this.jsPsych = jsPsych;
  }

  /** @param {HTMLElement} display @param {any} trial @param {() => void} on_load */
  async trial(display, trial, on_load) {
    const signal = trial.signal();
    const over = new AbortController();
    const visibility = watchVisibility(over.signal);
    let [failed, hidden] = [0, 0];
    try {
      for (let attempt = 1; ; attempt++) {
        await pageVisible();
        const seen = whileSeen(signal, hidden < REPEATS);
        const showing = { ...trial, attempt, failed, hidden, seen };
        try {
          return await show(display, showing, signal, visibility, on_load);
        } catch (error) {
          if (signal.aborted) throw error;
          if (error instanceof PageHidden) hidden += 1;
          else if (error instanceof MovieFailed) {
            failed += 1;
            const { trial: number } = trial.media;
            trial.log("movie_failed", { trial: number, attempt, reason: error.message });
            await tellTrouble(display, trial, failed);
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

/** One showing of the trial, from the fixation cross to the answer. */
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

/** What happens on the screen, in its order. */
async function run(screen, cross, buttons, trial, signal, visibility) {
  const start = await nextFrame();
  const loaded = trial.load(trial.failed).then((addresses) => screen.load(addresses));
  await Promise.all([loaded, reach(start + trial.fixation_ms, trial.seen.signal)]);
  const fixation_ms = round((await nextFrame()) - start);
  cross.remove();
  trial.shown();
  const cue = await screen.flash({ ms: trial.cue_ms, hz: trial.flash_hz });
  const movie = await screen.play({ hide: true });
  trial.seen.end();
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
    details: {
      attempts: trial.before + trial.attempt,
      hidden: trial.hidden + (trial.seen.wasHidden() ? 1 : 0),
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

/** Resolves in the first frame of the screen at or after the moment. */
async function reach(moment, signal) {
  while ((await nextFrame()) < moment) signal.throwIfAborted();
}

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
 * Enable the buttons in the next frame of the screen and wait for one of them, or its key. The time
 * is that of the press, by mouse, finger or key. Presses that began before do not count, nor do
 * keys held down.
 */
function answered(buttons, trial, signal) {
  const over = new AbortController();
  const options = { signal: over.signal };
  return new Promise((resolve, reject) => {
    signal.addEventListener("abort", () => reject(signal.reason), options);
    requestAnimationFrame(() => {
      const enabled = performance.now();
      for (const one of buttons) one.disabled = false;
      const give = (event, side, input) => {
        const rt_ms = event.timeStamp - enabled;
        if (rt_ms >= 0) resolve({ response: trial.choices[side], rt_ms, input, enabled });
      };
      buttons.forEach((one, side) => {
        let down = null;
        one.addEventListener("pointerdown", (event) => (down = event), options);
        const clicked = (event) => {
          if (event.detail === 0) give(event, side, "keyboard");
          else if (down) give(down, side, inputOf(down));
        };
        one.addEventListener("click", clicked, options);
      });
      const pressed = (event) => {
        const side = sideOf(event, trial.keys);
        if (side >= 0 && !isAsked()) give(event, side, "keyboard");
      };
      document.addEventListener("keydown", pressed, options);
    });
  }).finally(() => over.abort());
}

/** Which of the keys was pressed, -1 for none. Without Latin letters the key's place counts. */
function sideOf(event, keys) {
  if (event.repeat || event.ctrlKey || event.altKey || event.metaKey) return -1;
  const side = keys.indexOf(event.key.toLowerCase());
  if (side >= 0 || /^[\x20-\x7e]$/.test(event.key)) return side;
  return keys.findIndex((key) => event.code === `Key${key.toUpperCase()}`);
}

function inputOf({ pointerType }) {
  return pointerType === "touch" || pointerType === "pen" ? "touch" : "mouse";
}

/**
 * A signal that also ends what runs when the page is hidden, where `repeat` says so, until `end`.
 * @param {AbortSignal} signal @param {boolean} repeat
 */
function whileSeen(signal, repeat) {
  const seen = new AbortController();
  const over = new AbortController();
  const options = { signal: over.signal };
  let was = false;
  const stop = () => seen.abort(signal.reason);
  const changed = () => {
    if (!document.hidden) return;
    was = true;
    if (repeat) seen.abort(new PageHidden("the page was hidden"));
  };
  signal.addEventListener("abort", stop, options);
  document.addEventListener("visibilitychange", changed, options);
  if (signal.aborted) stop();
  return { signal: seen.signal, end: () => over.abort(), wasHidden: () => was };
}

function watchVisibility(signal) {
  const changes = [];
  const changed = () => changes.push([performance.now(), document.visibilityState]);
  document.addEventListener("visibilitychange", changed, { signal });
  return { changes };
}

/** Say that the movie did not play; after some tries, wait for the participant. */
async function tellTrouble(display, trial, attempt) {
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
