/**
 * One trial as pieces of a jsPsych timeline: the window is large enough, its media are loaded, the
 * prediction, and in practice the feedback.
 * @module trial_pieces
 */

import { Refused } from "./api.js";
import { FeedbackTrial } from "./feedback_trial.js";
import { windowFits } from "./gate.js";
import { PageTrial } from "./page_trial.js";
import * as pages from "./pages.js";
import { PredictionTrial } from "./prediction_trial.js";

const TRIAL_WORDS = ["prompt", "yes", "no", "trouble", "retry"];
const FEEDBACK_WORDS = ["waiting", "correct", "incorrect", "contact", "no_contact", "next"];

/**
 * @param {any} context See pages.js; with the frame besides.
 * @param {"familiarization"|"test"} phase
 * @param {any} media `TrialMedia`
 * @param {Object} session
 * @param {Map<string, number>} session.shown How often each scene was begun to be seen.
 * @param {() => void} session.started
 * @param {(data: any) => {answer: any, stored: Promise<any>}} session.answered
 * @returns {Array<Object>}
 */
export function trialPieces(context, phase, media, session) {
  let given = null;
  const prediction = predictionOf(context, phase, media, session);
  const answered = (data) => {
    if (data.response) given = session.answered(data); // else it was left before
  };
  return [
    ...beforeTrial(context, media.trial),
    { ...prediction, on_finish: answered },
    ...(phase === "familiarization" ? [feedbackOf(context, media, () => given)] : []),
  ];
}

/** Pages that are shown where the window is too small, or the media are not there yet. */
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
    page(pages.windowPage(context, fits), small),
    page(pages.loadingPage(context), loading),
  ];
}

function predictionOf({ study, texts, frame, log, state, ...context }, phase, media, session) {
  const number = media.trial;
  const place = `${phase} ${number}`;
  const seen = () => session.shown.get(place) ?? 0;
  return {
    type: PredictionTrial,
    media,
    load: (failed) => (failed > 0 ? context.media.reload(number) : context.media.get(number)),
    fixation_ms: media.fixation_ms,
    cue_ms: study.cue_ms,
    flash_hz: study.flash_hz,
    choices: state.buttons.split("-"),
    words: words(texts, "trial", TRIAL_WORDS),
    before: seen,
    shown: () => session.shown.set(place, seen() + 1),
    log: (kind, data) => log.add(kind, data),
    on_start: () => {
      session.started();
      context.media.advance(number);
      frame.progress(phase, number);
    },
  };
}

/** What was right, once the answer is stored. @param {() => any} given Answer and its storing. */
function feedbackOf({ api, texts, log }, media, given) {
  return {
    type: FeedbackTrial,
    media,
    feedback: async () => (await given().stored).feedback,
    load: async (path) => URL.createObjectURL(await fullMovie(api, path, given().answer)),
    words: {
      ...words(texts, "practice", FEEDBACK_WORDS),
      trouble: texts.t("trial.trouble"),
      prompt: texts.t("trial.prompt"),
    },
    log: (kind, data) => log.add(kind, data),
  };
}

/** The whole movie; the same answer sent again gives a new address where this one is refused. */
async function fullMovie(api, path, answer) {
  try {
    return await api.blob(path);
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
    const { feedback } = await api.post("/api/answers", answer);
    return api.blob(feedback.movie);
  }
}

/** Words of a table of the texts by their names there. */
function words(texts, table, names) {
  return Object.fromEntries(names.map((name) => [name, texts.t(`${table}.${name}`)]));
}
