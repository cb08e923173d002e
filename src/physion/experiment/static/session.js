/**
 * A session. The state given by the server determines the next part of the experiment, which runs
 * as a jsPsych timeline; when it has ended, or the server reports another state, the next part
 * follows.
 * @module session
 */

import { announce, newShowing } from "./answer_queue.js";
import { Refused } from "./api.js";
import { consentPage } from "./consent_page.js";
import { endedPage, resultPage, stopQuestion } from "./ending_pages.js";
import { hideAddress } from "./entering.js";
import { comprehensionPage, demographicsPage, feedbackPage, questionPage } from "./forms.js";
import { leaveFullscreen } from "./fullscreen.js";
import { Media } from "./media.js";
import { ask, PageTrial, patiently, showPage } from "./page_trial.js";
import * as pages from "./pages.js";
import { PredictionTrial } from "./prediction_trial.js";
import { dueFeedback, forgetFeedback, forgetSession, rememberFeedback } from "./remembered.js";
import { newKey } from "./storage.js";
import { feedbackPieces, repeatBefore, trialPieces } from "./trial_pieces.js";

const PAGES = {
  consent: consentPage,
  instructions: pages.instructionsPages,
  comprehension: comprehensionPage,
  ready: pages.readyPage,
  demographics: demographicsPage,
  questions: questionPage,
  feedback: feedbackPage,
};

/** Refusals after which no session of this page can continue. */
const FINAL = ["unknown_token", "bad_link", "id_needed", "already_took_part", "study_full", "held",
  "paused"];

/** @typedef {import("./messages.js").SessionState} SessionState */

/**
 * The objects that exist before a session.
 * @typedef {Object} Basis
 * @property {import("./api.js").Api} api
 * @property {import("./texts.js").Texts} texts
 * @property {import("./messages.js").PublicStudy} study
 * @property {import("./event_log.js").EventLog} log
 * @property {import("./frame.js").Frame} frame
 * @property {string} address The URL by which the participant came.
 * @property {(language: string) => Promise<void>} [setLanguage] Changes the language.
 * @property {(() => void)|null} [another] Starts the study for another person; null if it cannot.
 */

/** Raised when the running part of the timeline is left for another state. */
class PartLeft extends Error {}

/** Runs a session from its current state to its end. */
export class Session {
  /** Aborts the running part. */
  #part = new AbortController();
  #closed = false;
  /** The last refusal of an answer. @type {Refused|null} */
  #refused = null;
  /** Closes the question whether to stop, while it is open. @type {AbortController|null} */
  #question = null;
  #withdraws = false;
  /**
   * The running trial with its last showing, and how often the question was opened during it.
   * @type {{phase: string|null, trial: number|null, asked: number,
   *   showing: import("./answer_queue.js").Announced|null}}
   */
  #running = { phase: null, trial: null, asked: 0, showing: null };
  /** How often the scene of a trial was shown, by phase and trial. @type {Map<string, number>} */
  #shown = new Map();

  /**
   * @param {Basis} basis
   * @param {import("./answer_queue.js").AnswerQueue} queue Reports its refusals to `refused`.
   */
  constructor(basis, queue) {
    this.basis = basis;
    this.queue = queue;
    this.media = new Media(basis.api, basis.study.preload);
    /** @type {SessionState|null} */
    this.state = null;
  }

  /** The objects that pages use. @returns {import("./pages.js").Context} */
  get context() {
    const study = { ...this.basis.study, ...this.state?.settings };
    return { ...this.basis, study, media: this.media, state: this.state };
  }

  /** Continue from the server's state after the refusal of an answer. @param {Refused} error */
  refused(error) {
    this.#refused = error;
    this.#leave();
  }

  /** End the session in this tab because another tab has taken over. */
  close() {
    this.#closed = true;
    this.#question?.abort();
    this.queue.close();
    this.#leave();
  }

  /** Ask whether to stop; the trial and its response time continue behind the question. */
  async askToStop() {
    if (this.#question) return;
    this.#question = new AbortController();
    const { phase, trial } = this.#running;
    const { log } = this.basis;
    log.add("stop_asked", { stage: this.state.stage, phase, trial });
    this.#running.asked += 1;
    const answer = await ask(stopQuestion(this.context), this.#question.signal);
    this.#question = null;
    const stop = Boolean(answer?.stop);
    log.add("stop_answered", { stage: this.state.stage, phase, trial, stop });
    if (!stop) return;
    this.#withdraws = true;
    this.#leave();
  }

  /** Run the session to its end. @param {SessionState} state @returns {Promise<void>} */
  async run(state) {
    this.state = state;
    while (!this.#closed) {
      this.#part = new AbortController();
      // The consent can be read in any language, which becomes the language of the session.
      const { stage } = this.state;
      const reading = stage === "consent" || stage === "declined";
      this.basis.texts.scenario = this.state.scenario;
      this.basis.texts.condition = this.state.condition;
      if (!reading) await this.basis.setLanguage(this.state.language);
      this.basis.frame.show(this.context);
      try {
        this.state = await this.#next();
      } catch (error) {
        if (this.#closed) return;
        this.state = await this.#stateAfter(error);
      }
    }
  }

  /** Run the current stage, or show the end. @returns {Promise<SessionState>} */
  #next() {
    const { stage } = this.state;
    if (stage === "done") return this.#end();
    return this.state.ended ? this.#ended() : this.#stage();
  }

  /** Show the current page again, in another language. */
  restart() {
    this.#leave();
  }

  #leave() {
    this.#part.abort(new PartLeft());
  }

  /**
   * Return the state from which to continue after an error; throw the error if it is fatal.
   * @param {any} error
   * @returns {Promise<SessionState>}
   */
  async #stateAfter(error) {
    const { api, log } = this.basis;
    const refused = error instanceof Refused ? error : this.#refused;
    if (FINAL.includes(refused?.code) || this.queue.waits(api.token)) {
      throw refused ?? error;
    }
    if (!(error instanceof Refused) && !(error instanceof PartLeft)) {
      log.add("error", { message: String(error) });
      throw error;
    }
    // Send waiting answers first, so that the state counts them.
    if (this.queue.length > 0) showPage(this.basis.frame.main, this.#waiting());
    await this.queue.empty();
    if (this.#withdraws) return this.#withdraw();
    const known = this.#refused?.state ?? refused?.state;
    this.#refused = null;
    const request = (path) => this.#patiently(api.get(path));
    const state = this.queue.length === 0 && known ? known : await request("/api/session");
    // A trial that was seen already is marked in its answer, as after a reload.
    const seen = this.#shown.has(`${state.stage} ${state.trial}`);
    return seen ? request("/api/session?load=true") : state;
  }

  /** Withdraw from the study. @returns {Promise<SessionState>} */
  async #withdraw() {
    const { api, log } = this.basis;
    this.#withdraws = false;
    await this.#patiently(log.send());
    try {
      return await this.#patiently(api.post("/api/page", { page: "withdraw", data: {} }));
    } catch (error) {
      if (!error.state) throw error;
      return error.state;
    }
  }

  /**
   * Render the page shown while answers are being sent.
   * @returns {(page: HTMLElement, done?: () => void) => void}
   */
  #waiting() {
    const render = pages.waitingPage(this.context, () => this.queue.empty());
    return (page, done = () => {}) => render(page, done);
  }

  /** Run the current stage. @returns {Promise<SessionState>} The state after it. */
  async #stage() {
    const { stage } = this.state;
    const due = dueFeedback(this.state);
    if (due) await this.#showFeedback(due);
    if (stage === "familiarization" || stage === "test") return this.#phase(stage);
    if (stage !== "ready") leaveFullscreen();
    return this.#page(stage, PAGES[stage](this.context));
  }

  /** Run a page and store it. @returns {Promise<SessionState>} */
  async #page(page, render) {
    const { signal } = this.#part;
    let outcome = null;
    const store = async (data) => {
      if (page === "consent") data.language = this.basis.texts.language;
      const post = this.basis.api.post("/api/page", { page, data }, { signal });
      // Refusals are handled by `run`; the page has ended in any case.
      outcome = await post.catch((error) => ({ error }));
    };
    const stored = pages.storedPage(this.context, render, store);
    await this.#timeline([{ type: PageTrial, render: stored }]);
    if (outcome.error) throw outcome.error;
    if (page === "consent") this.#decided(outcome);
    return outcome;
  }

  /** Keep or forget what belongs to the person, as the consent says. @param {SessionState} state */
  #decided(state) {
    const { api, log } = this.basis;
    if (state.stage === "declined") {
      log.drop();
      forgetSession();
      return;
    }
    log.begin();
    hideAddress(api.token);
  }

  /** Await a promise, with a page meanwhile if it takes long. */
  #patiently(awaited) {
    return patiently(this.basis.frame.main, pages.openingPage(this.context), awaited);
  }

  /**
   * Run the remaining trials of a phase.
   * @returns {Promise<SessionState>} The state after them.
   */
  async #phase(phase) {
    const { api } = this.basis;
    const { signal } = this.#part;
    const list = async () => (await api.get(`/api/trials/${phase}`, { signal })).trials;
    const trials = await this.#patiently(list());
    this.media.start(trials, this.state.trial, list);
    const remaining = trials.filter((trial) => trial.trial >= this.state.trial);
    await this.#timeline([
      ...repeatBefore(this.context, phase),
      ...remaining.flatMap((media) => this.#trial(phase, media)),
      {
        timeline: [{ type: PageTrial, render: this.#waiting() }],
        conditional_function: () => this.queue.length > 0,
      },
    ]);
    const next = await this.#patiently(api.get("/api/session", { signal }));
    // A repeated practice shows its scenes anew.
    if (next.practice_repeats > this.state.practice_repeats) this.#shown.clear();
    return next;
  }

  /** Show the feedback of a practice trial that the participant has not seen to its end. */
  async #showFeedback(answer) {
    const { api, frame } = this.basis;
    const { signal } = this.#part;
    frame.show({ state: { ...this.state, stage: "familiarization" } });
    try {
      const list = async () => (await api.get("/api/trials/familiarization", { signal })).trials;
      const trials = await this.#patiently(list());
      this.media.start(trials, answer.trial, list);
      // The answer is stored already; sent again, it gives the same feedback.
      const stored = this.#patiently(api.post("/api/answers", answer, { signal }));
      stored.catch(() => {}); // the timeline receives the error as well
      const media = trials.find((each) => each.trial === answer.trial);
      await this.#timeline(feedbackPieces(this.context, media, { answer, stored }));
      frame.show(this.context);
    } catch (error) {
      if (error instanceof Refused) forgetFeedback();
      throw error;
    }
  }

  /** Return the timeline of one trial. */
  #trial(phase, media) {
    const { trial } = media;
    return trialPieces(this.context, phase, media, {
      shown: this.#shown,
      started: () => (this.#running = { phase, trial, asked: 0, showing: null }),
      began: () => this.#announce(phase, trial),
      answered: (data) => {
        const details = { ...data.details, stop_asked: this.#running.asked };
        const answer = answerOf(phase, trial, { ...data, details });
        this.state = { ...this.state, trial: trial + 1, answered: true };
        const feedback = this.state.settings.familiarization_feedback;
        if (phase === "familiarization" && feedback) rememberFeedback(this.state.reference, answer);
        return { answer, stored: this.queue.add(answer, this.#running.showing) };
      },
    });
  }

  /** Tell the server that a showing begins; the queue does it again if this fails. */
  #announce(phase, trial) {
    const showing = newShowing(phase, trial);
    this.#running.showing = showing;
    announce(this.basis.api, showing, { signal: this.#part.signal }).catch(() => {});
  }

  /** Run a jsPsych timeline and return the data of its trials. */
  async #timeline(pieces) {
    const { signal } = this.#part;
    signal.throwIfAborted();
    const main = this.basis.frame.main;
    main.replaceChildren();
    const jsPsych = window.initJsPsych({
      display_element: main,
      use_webaudio: false,
      // jsPsych makes its container reachable by the Tab key, where there is nothing to do.
      on_trial_start: () => (main.tabIndex = -1),
    });
    const abort = () => jsPsych.abortExperiment();
    signal.addEventListener("abort", abort);
    try {
      await jsPsych.run([{ timeline: pieces, signal: () => signal }]);
    } finally {
      signal.removeEventListener("abort", abort);
    }
    this.#running = { phase: null, trial: null, asked: 0, showing: null };
    signal.throwIfAborted();
    return jsPsych.data.get().values();
  }

  /** Show that the session was declined or has ended early. @returns {Promise<never>} */
  async #ended() {
    this.#question?.abort();
    const { api, frame } = this.basis;
    const { signal } = this.#part;
    const ending = await this.#patiently(api.get("/api/ending", { signal }));
    showPage(frame.main, endedPage(this.context, ending));
    return new Promise((_, reject) => {
      signal.addEventListener("abort", () => reject(signal.reason));
    });
  }

  /** Show the result. @returns {Promise<never>} */
  async #end() {
    this.#question?.abort();
    const { api, frame } = this.basis;
    const { signal } = this.#part;
    const result = await this.#patiently(api.get("/api/result", { signal }));
    showPage(frame.main, resultPage(this.context, result));
    return new Promise((_, reject) => {
      signal.addEventListener("abort", () => reject(signal.reason));
    });
  }
}

/**
 * Return the message with the data of a prediction trial.
 * @returns {any} An `Answer`.
 */
function answerOf(phase, trial, data) {
  const names = Object.keys(PredictionTrial.info.data);
  const measured = Object.fromEntries(names.map((name) => [name, data[name]]));
  return { key: newKey(), phase, trial, ...measured, break_ms: data.break_ms };
}
