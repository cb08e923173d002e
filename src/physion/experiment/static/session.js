/**
 * A session: from the state that the server tells, the next stretch of the experiment as a jsPsych
 * timeline; when it has ended, or the server has told of another state, the next one.
 * @module session
 */

import { Refused } from "./api.js";
import { ask } from "./dialog.js";
import { demographicsPage, feedbackPage } from "./forms.js";
import { Media } from "./media.js";
import { PageTrial, patiently, showPage } from "./page_trial.js";
import * as pages from "./pages.js";
import { PredictionTrial } from "./prediction_trial.js";
import { newKey } from "./random_key.js";
import { resultPage } from "./result_page.js";
import { keep, recall } from "./storage.js";
import { trialPieces } from "./trial_pieces.js";

const PAGES = {
  consent: pages.consentPage,
  instructions: pages.instructionsPages,
  ready: pages.readyPage,
  demographics: demographicsPage,
  feedback: feedbackPage,
};

/** The stretch of the timeline that runs was left for another state. */
class Left extends Error {}

export class Session {
  #stretch = new AbortController();
  #closed = false;
  #refused = null;
  /** The question whether to stop, while it is asked. */
  #question = null;
  #withdraws = false;
  /** The trial that runs, and how often the question was asked during it. */
  #running = { phase: null, trial: null, asked: 0 };
  /** How often the scene of a trial was begun to be seen, by phase and trial. */
  #shown = new Map();

  /**
   * @param {any} basis api, texts, study, log, frame (see frame.js), address; `speak` goes on in
   *   another language; `another` begins anew for another person, null where that cannot be.
   * @param {import("./answer_queue.js").AnswerQueue} queue Its refusals come to `refused`.
   */
  constructor(basis, queue) {
    this.basis = basis;
    this.queue = queue;
    this.media = new Media(basis.api, basis.study.preload);
    this.state = null;
  }

  /** Everything that pages need. @returns {import("./pages.js").Context} */
  get context() {
    return { ...this.basis, media: this.media, state: this.state };
  }

  /** An answer was refused: go on from the state that the server told. */
  refused(error) {
    this.#refused = error;
    this.#leave();
  }

  /** Another tab has taken over. */
  close() {
    this.#closed = true;
    this.#question?.abort();
    this.queue.close();
    this.#leave();
  }

  /** The participant asks to stop: what runs goes on below the question, and so does its clock. */
  async askToStop() {
    if (this.#question) return;
    this.#question = new AbortController();
    const { phase, trial } = this.#running;
    const { log } = this.basis;
    log.add("stop_asked", { stage: this.state.stage, phase, trial });
    this.#running.asked += 1;
    const answer = await ask(pages.stopPage(this.context), this.#question.signal);
    this.#question = null;
    const stop = Boolean(answer?.stop);
    log.add("stop_answered", { stage: this.state.stage, phase, trial, stop });
    if (!stop) return;
    this.#withdraws = true;
    this.#leave();
  }

  /** Go through the session to its end. @param {any} state `State` @returns {Promise<void>} */
  async run(state) {
    this.state = state;
    while (!this.#closed) {
      this.#stretch = new AbortController();
      // The consent is read in any language, and then the session is in that one.
      const reading = this.state.stage === "consent" || this.#declined();
      if (!reading) await this.basis.speak(this.state.language);
      this.basis.frame.show(this.context);
      if (this.state.stage === "done" || this.state.stage === "withdrawn") return this.#end();
      try {
        this.state = await this.#stage();
      } catch (error) {
        if (this.#closed) return;
        this.state = await this.#stateAfter(error);
      }
    }
  }

  /** Was the consent declined, in this browser? The server keeps no language of who did. */
  #declined() {
    return this.state.stage === "withdrawn" && recall("declined") === this.state.reference;
  }

  /** Show the page that is shown anew, in another language. */
  restart() {
    this.#leave();
  }

  #leave() {
    this.#stretch.abort(new Left());
  }

  async #stateAfter(error) {
    const { api, log } = this.basis;
    const refused = error instanceof Refused ? error : this.#refused;
    if (refused?.code === "unknown_token" || this.queue.waits(api.token)) {
      throw refused ?? error;
    }
    if (!(error instanceof Refused) && !(error instanceof Left)) {
      log.add("error", { message: String(error) });
      throw error;
    }
    // Answers that are still on their way come first: the state then counts them.
    if (this.queue.length > 0) showPage(this.basis.frame.main, this.#waiting());
    await this.queue.empty();
    if (this.#withdraws) return this.#withdraw();
    const told = this.#refused?.state ?? refused?.state;
    this.#refused = null;
    const ask = (path) => this.#patiently(api.get(path));
    const state = this.queue.length === 0 && told ? told : await ask("/api/session");
    // What was seen already is marked in the answer as after a reload.
    const seen = this.#shown.has(`${state.stage} ${state.trial}`);
    return seen ? ask("/api/session?load=true") : state;
  }

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

  #waiting() {
    const render = pages.waitingPage(this.context, () => this.queue.empty());
    return (page, done = () => {}) => render(page, done);
  }

  #stage() {
    const { stage } = this.state;
    if (stage === "familiarization" || stage === "test") return this.#phase(stage);
    return this.#page(stage, PAGES[stage](this.context));
  }

  async #page(page, render) {
    const { signal } = this.#stretch;
    let told = null;
    const store = async (data) => {
      if (page === "consent") data.language = this.basis.texts.language;
      if (data.agreed === false) keep("declined", this.state.reference);
      const post = this.basis.api.post("/api/page", { page, data }, { signal });
      // Refusals are for `run`; the page has ended either way.
      told = await post.catch((error) => ({ error }));
    };
    const stored = pages.storedPage(this.context, render, store);
    await this.#timeline([{ type: PageTrial, render: stored }]);
    if (told.error) throw told.error;
    return told;
  }

  /** What is awaited, with a page in between where it takes long. */
  #patiently(awaited) {
    return patiently(this.basis.frame.main, pages.openingPage(this.context), awaited);
  }

  /** All trials of a phase that are not answered yet, and then the state after them. */
  async #phase(phase) {
    const { api } = this.basis;
    const { signal } = this.#stretch;
    const list = async () => (await api.get(`/api/trials/${phase}`, { signal })).trials;
    const trials = await this.#patiently(list());
    this.media.start(trials, this.state.trial, list);
    const left = trials.filter((trial) => trial.trial >= this.state.trial);
    await this.#timeline([
      ...left.flatMap((media) => this.#trial(phase, media)),
      {
        timeline: [{ type: PageTrial, render: this.#waiting() }],
        conditional_function: () => this.queue.length > 0,
      },
    ]);
    return this.#patiently(api.get("/api/session", { signal }));
  }

  #trial(phase, media) {
    const { trial } = media;
    return trialPieces(this.context, phase, media, {
      shown: this.#shown,
      started: () => (this.#running = { phase, trial, asked: 0 }),
      answered: (data) => {
        const details = { ...data.details, stop_asked: this.#running.asked };
        const answer = answerOf(phase, trial, { ...data, details });
        this.state = { ...this.state, trial: trial + 1 };
        return { answer, stored: this.queue.add(answer) };
      },
    });
  }

  /** Run a timeline; gives what its trials gave. */
  async #timeline(pieces) {
    const { signal } = this.#stretch;
    signal.throwIfAborted();
    const main = this.basis.frame.main;
    main.replaceChildren();
    const jsPsych = window.initJsPsych({
      display_element: main,
      use_webaudio: false,
      // jsPsych makes its place a stop of the Tab key, at which there is nothing to do.
      on_trial_start: () => (main.tabIndex = -1),
    });
    const abort = () => jsPsych.abortExperiment();
    signal.addEventListener("abort", abort);
    try {
      await jsPsych.run([{ timeline: pieces, signal: () => signal }]);
    } finally {
      signal.removeEventListener("abort", abort);
    }
    this.#running = { phase: null, trial: null, asked: 0 };
    signal.throwIfAborted();
    return jsPsych.data.get().values();
  }

  async #end() {
    this.#question?.abort();
    const { texts, study, api, frame, another } = this.basis;
    if (this.state.stage === "withdrawn") {
      const { reference } = this.state;
      const declined = this.#declined();
      const named = `\n\n${texts.t("common.reference", { reference })}`;
      const title = texts.t(declined ? "declined.title" : "withdrawn.title");
      const text = declined
        ? texts.t("declined.text", study)
        : texts.t("withdrawn.text", study) + named;
      const quiet = another && { label: texts.t("common.another_person"), run: another };
      return showPage(frame.main, pages.messagePage({ title, text, quiet }));
    }
    const result = await this.#patiently(api.get("/api/result"));
    return showPage(frame.main, resultPage(this.context, result));
  }
}

/** An `Answer` from the data of a prediction trial. */
function answerOf(phase, trial, data) {
  const names = Object.keys(PredictionTrial.info.data);
  const measured = Object.fromEntries(names.map((name) => [name, data[name]]));
  return { key: newKey(), phase, trial, ...measured };
}
