/**
 * The jsPsych timeline of one trial: offer a break and full screen, check the window size, wait for the media, show
 * the prediction trial and, in practice, the feedback.
 * @module trial_pieces
 */

import { Refused } from "./api.js";
import { FeedbackTrial } from "./feedback_trial.js";
import { fullscreenPage, offersFullscreen } from "./fullscreen.js";
import { windowFits } from "./gate.js";
import { PageTrial, showPage } from "./page_trial.js";
import * as pages from "./pages.js";
import { PredictionTrial } from "./prediction_trial.js";
import { forgetFeedback } from "./remembered.js";
import { round } from "./screen.js";

const DAY_MS = 86_400_000;
const TRIAL_WORDS = ["prompt", "yes", "no", "trouble", "retry"];
const FEEDBACK_WORDS = ["waiting", "correct", "incorrect", "contact", "no_contact", "next"];

/** @typedef {import("./messages.js").TrialMedia} TrialMedia */
/**
 * An answer and the promise of its acknowledgement.
 * @typedef {{answer: any, stored: Promise<any>}} Given
 */

/**
 * Return the timeline of one trial.
 * @param {import("./pages.js").Context} context
 * @param {import("./messages.js").Phase} phase
 * @param {TrialMedia} media
 * @param {Object} session
 * @param {Map<string, number>} session.shown How often each scene was shown.
 * @param {() => void} session.started Called when the trial starts.
 * @param {() => void} session.began Called when a showing of the trial begins.
 * @param {(data: any) => Given} session.answered Called with the data of the trial.
 * @returns {Array<Object>}
 */
export function trialPieces(context, phase, media, session) {
  /** @type {Given|null} */
  let given = null;
  /** Duration of the break before the trial. @type {number|null} */
  let break_ms = null;
  const withFeedback = phase === "familiarization" && context.study.familiarization_feedback;
  const prediction = predictionOf(context, phase, media, session);
  const answered = (data) => {
    // Without a response the trial was left.
    if (data.response) given = session.answered({ ...data, break_ms });
  };
  return [
    ...breakBefore(context, phase, media.trial, (ms) => (break_ms = ms)),
    ...beforeTrial(context, media.trial),
    { ...prediction, on_finish: answered },
    ...(withFeedback ? [feedbackOf(context, media, () => given)] : []),
  ];
}

/**
 * Return the page before a practice that is repeated, at its first trial.
 * @param {import("./pages.js").Context} context
 * @param {import("./messages.js").Phase} phase
 * @returns {Array<Object>}
 */
export function repeatBefore(context, phase) {
  const { state } = context;
  const first = phase === "familiarization" && state.trial === 0;
  if (!first || state.practice_repeats === 0) return [];
  return [{ type: PageTrial, render: pages.repeatPage(context) }];
}

/**
 * Return the timeline that shows the feedback of an answered practice trial once more.
 * @param {import("./pages.js").Context} context
 * @param {TrialMedia} media
 * @param {Given} given
 * @returns {Array<Object>}
 */
export function feedbackPieces(context, media, given) {
  return [...beforeTrial(context, media.trial), feedbackOf(context, media, () => given)];
}

/**
 * Return the break before a test trial, if one is due.
 * @param {import("./pages.js").Context} context
 * @param {import("./messages.js").Phase} phase
 * @param {number} number
 * @param {(ms: number) => void} rested Called with the duration of the break.
 * @returns {Array<Object>}
 */
function breakBefore(context, phase, number, rested) {
  const every = context.study.break_every;
  if (phase !== "test" || every === 0 || number === 0 || number % every !== 0) return [];
  let start = 0;
  return [
    {
      type: PageTrial,
      render: pages.breakPage(context, number),
      on_start: () => {
        start = performance.now();
        context.log.add("break", { trial: number });
      },
      on_finish: () => rested(Math.min(round(performance.now() - start), DAY_MS)),
    },
  ];
}

/** Return the pages shown if the window is too small or the media are not loaded yet. */
function beforeTrial(context, number) {
  const { study, log, media } = context;
  const fits = () => windowFits(study);
  const small = () => {
    if (!fits()) log.add("too_small", { width: innerWidth, height: innerHeight });
    return !fits();
  };
  const loading = () => {
    media.advance(number);
    return !media.isReady(number);
  };
  const page = (render, condition) => ({
    timeline: [{ type: PageTrial, render }],
    conditional_function: condition,
  });
  return [
    page(fullscreenPage(context), () => offersFullscreen(study)),
    page(pages.windowPage(context, fits), small),
    page(pages.loadingPage(context), loading),
  ];
}

/** Show the page about the window until it is large enough. */
function enlarged(context, display, signal) {
  const fits = () => windowFits(context.study);
  context.log.add("too_small", { width: innerWidth, height: innerHeight });
  return new Promise((resolve, reject) => {
    const over = new AbortController();
    signal.addEventListener("abort", () => reject(signal.reason), { signal: over.signal });
    const done = () => {
      over.abort();
      resolve(null);
    };
    const render = pages.windowPage(context, fits);
    showPage(display, (page) => render(page, done, over.signal));
  });
}

/** Return the prediction trial. */
function predictionOf(context, phase, media, session) {
  const { study, texts, frame, log, state } = context;
  const number = media.trial;
  const key = `${phase} ${number}`;
  const seen = () => session.shown.get(key) ?? 0;
  return {
    type: PredictionTrial,
    media,
    load: (failed) => (failed > 0 ? context.media.reload(number) : context.media.get(number)),
    fixation_ms: media.fixation_ms,
    cue_ms: study.cue_ms,
    flash_hz: study.flash_hz,
    choices: state.buttons.split("-"),
    words: words(texts, "trial", TRIAL_WORDS),
    instruction: media.instructed ? texts.t(`attention.press_${media.instructed}`) : "",
    repeat: study.interrupted === "repeat",
    fits: () => windowFits(study),
    enlarge: (display, signal) => enlarged(context, display, signal),
    before: seen,
    began: () => session.began(),
    shown: () => session.shown.set(key, seen() + 1),
    log: (kind, data) => log.add(kind, data),
    on_start: () => {
      session.started();
      context.media.advance(number);
      frame.progress(phase, number);
    },
  };
}

/**
 * Return the feedback trial, which waits until the answer is stored, and forgets at its end that the
 * feedback is due.
 * @param {import("./pages.js").Context} context
 * @param {TrialMedia} media
 * @param {() => Given} given
 */
function feedbackOf({ api, texts, log, study, frame, ...context }, media, given) {
  const load = async (path) => {
    const { map } = await context.media.get(media.trial);
    return { movie: URL.createObjectURL(await fullMovie(api, path, given().answer)), map };
  };
  return {
    type: FeedbackTrial,
    media,
    feedback: async () => (await given().stored).feedback,
    load,
    cue_ms: study.cue_ms,
    flash_hz: study.flash_hz,
    on_start: () => frame.progress("familiarization", media.trial),
    on_finish: (data) => {
      if ("contact" in data) forgetFeedback(); // else it was left, and is shown again
    },
    words: {
      ...words(texts, "practice", FEEDBACK_WORDS),
      trouble: texts.t("trial.trouble"),
      prompt: texts.t("trial.prompt"),
    },
    log: (kind, data) => log.add(kind, data),
  };
}

/** Fetch the full movie; if its URL is refused, send the same answer again to get a new one. */
async function fullMovie(api, path, answer) {
  try {
    return await api.blob(path);
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    const { feedback } = await api.post("/api/answers", answer);
    return api.blob(feedback.movie);
  }
}

/** Return texts of a table by name. */
function words(texts, table, names) {
  return Object.fromEntries(names.map((name) => [name, texts.t(`${table}.${name}`)]));
}
