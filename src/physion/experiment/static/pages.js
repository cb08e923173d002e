/**
 * The pages between the trials. Each function returns the `render` parameter of a `PageTrial`.
 * @module pages
 */

import { button, el, paragraphs, sleep } from "./dom.js";
import { showExample } from "./example.js";
import { wrongAttempt } from "./forms.js";
import { focusHeading } from "./page_trial.js";
import { bound } from "./texts.js";

const LATE_MS = 500;

/**
 * The objects that pages use.
 * @typedef {import("./session.js").Basis & {state: import("./messages.js").SessionState,
 *   media: import("./media.js").Media}} Context
 */

/**
 * Fills a page; calls `done` with its data when the participant has finished it.
 * @typedef {(page: HTMLElement, done: (values?: any) => void, signal: AbortSignal) => any} Render
 */

/** Estimate the rounded minutes of so many trials, with the pages before practice. */
export function minutes(study, practice, test) {
  const seconds = practice * 14 + test * (study.cue_ms / 1000 + 4.5);
  const exact = (practice ? 3 : 0) + seconds / 60;
  return exact > 7.5 ? Math.round(exact / 5) * 5 : Math.max(2, Math.ceil(exact));
}

/**
 * Render the instructions: three pages, with an animated example.
 * @param {Context} context
 * @returns {Render}
 */
export function instructionsPages(context) {
  const { texts, state } = context;
  const { t } = bound(texts);
  const prompt = t("trial.prompt");
  const counts = { practice: state.trials.familiarization, trials: state.trials.test };
  const checked = context.study.comprehension_questions.length > 0;
  const parts = [
    () => [
      el("h1", {}, t("instructions.title_task")),
      ...wrongAttempt(context),
      ...paragraphs(t("instructions.task", { prompt })),
    ],
    (signal) => [
      el("h1", {}, t("instructions.title_example")),
      ...paragraphs(t("instructions.example")),
      showExample(context, signal),
      el("p", { class: "small" }, t("instructions.example_alone")),
    ],
    () => [
      el("h1", {}, t("instructions.title_answer")),
      ...paragraphs(t("instructions.answer", counts)),
    ],
  ];
  return (page, done, signal) => {
    let over = new AbortController();
    signal.addEventListener("abort", () => over.abort());
    const show = (number) => {
      over.abort();
      over = new AbortController();
      const last = number === parts.length - 1;
      const back = () => show(number - 1);
      const next = () => (last ? done() : show(number + 1));
      page.replaceChildren(
        ...parts[number](over.signal),
        el(
          "div",
          { class: "buttons" },
          el("span", { class: "small" }, t("common.page_of", { page: number + 1, pages: 3 })),
          button(t("common.back"), back, { class: "button quiet", disabled: number === 0 }),
          button(t(last && !checked ? "instructions.start" : "common.next"), next),
        ),
      );
      focusHeading(page);
    };
    show(0);
  };
}

/** Render the page between practice and test. @param {Context} context @returns {Render} */
export function readyPage(context) {
  const { t } = bound(context.texts);
  const test = context.state.trials.test;
  const every = context.study.break_every;
  const values = { trials: test, minutes: minutes(context.study, 0, test) };
  const breaks = every > 0 && every < test ? paragraphs(t("ready.breaks", { every })) : [];
  return (page, done) =>
    page.append(
      el("h1", {}, t("ready.title")),
      ...paragraphs(t("ready.text", values)),
      ...breaks,
      el("div", { class: "buttons" }, button(t("ready.start"), () => done())),
    );
}

/** Render the page before a practice that is repeated. @param {Context} context @returns {Render} */
export function repeatPage({ texts, study, state }) {
  const { t } = bound(texts);
  const trials = state.trials.familiarization;
  const needed = Math.min(study.practice_min_correct, trials);
  return (page, done) =>
    page.append(
      el("h1", {}, t("practice.repeat_title")),
      ...paragraphs(t("practice.repeat_text", { needed, trials })),
      el("div", { class: "buttons" }, button(t("practice.repeat"), () => done())),
    );
}

/**
 * Render the break before a test trial; ends when the participant continues.
 * @param {Context} context
 * @param {number} answered Number of test trials before the break.
 * @returns {Render}
 */
export function breakPage({ texts, state }, answered) {
  const { t } = bound(texts);
  return (page, done) =>
    page.append(
      el("h1", {}, t("break.title")),
      ...paragraphs(t("break.text", { answered, trials: state.trials.test })),
      el("div", { class: "buttons" }, button(t("break.go_on"), () => done())),
    );
}

/**
 * Render the page shown until the next trials are loaded.
 * @param {Context} context
 * @returns {Render}
 */
export function loadingPage(context) {
  const { texts, media } = context;
  const { t } = bound(texts);
  return async (page, done, signal) => {
    const bar = el("progress", { "aria-label": t("trial.loading"), max: 1, value: 0 });
    const count = el("p", { class: "small" });
    const heading = el("h1", {}, t("trial.loading"));
    page.append(heading, bar, count);
    while (!signal.aborted) {
      const { loaded, wanted } = media.progress();
      bar.value = wanted ? loaded / wanted : 1;
      count.textContent = t("trial.loaded", { loaded, wanted });
      if (loaded >= wanted) return done();
      if (media.failed()) return retry();
      await sleep(100);
    }
    function retry() {
      const again = button(t("trial.retry"), () => {
        media.retry();
        page.replaceChildren();
        loadingPage(context)(page, done, signal);
      });
      page.replaceChildren(heading, el("p", { role: "alert" }, t("trial.media_failed")), again);
      again.focus();
    }
  };
}

/**
 * Render the page shown while answers are being sent.
 * @param {Context} context
 * @param {() => Promise<any>} waited
 * @returns {(page: HTMLElement, done: () => void) => void}
 */
export function waitingPage({ texts }, waited) {
  const { t } = bound(texts);
  return (page, done) => {
    page.append(el("h1", {}, t("saving.title")), el("p", {}, t("saving.text")));
    waited().then(() => done());
  };
}

/**
 * Render the page shown while a response takes long.
 * @param {{texts: import("./texts.js").Texts}} context
 * @returns {(page: HTMLElement) => void}
 */
export function openingPage({ texts }) {
  const { t } = bound(texts);
  return messagePage({ title: t("saving.title"), text: t("saving.opening") });
}

/**
 * Wrap a page so that it stays visible, with its input disabled, until its data are stored.
 * @param {{texts: any}} context
 * @param {Render} render
 * @param {(values: any) => Promise<any>} store Called once.
 * @returns {Render}
 */
export function storedPage({ texts }, render, store) {
  const { t } = bound(texts);
  return (page, done, signal) => {
    const status = el("span", { class: "small", role: "status" });
    const late = () => (status.textContent = t("saving.sending"));
    let sent = false;
    const send = async (values = {}) => {
      if (sent) return;
      sent = true;
      /** @type {NodeListOf<HTMLButtonElement>} */
      const controls = page.querySelectorAll("button, input, select, textarea");
      for (const control of controls) control.disabled = true;
      page.querySelector(".buttons")?.prepend(status);
      const timer = setTimeout(late, LATE_MS);
      await store(values).finally(() => clearTimeout(timer));
      done(values);
    };
    render(page, send, signal);
  };
}

/** Render the page shown while too many begin at once, with a countdown to the next attempt. */
export function busyPage({ texts }, ms) {
  const { t } = bound(texts);
  return async (page) => {
    const left = el("p", { class: "small", role: "timer" });
    page.append(el("h1", {}, t("busy.title")), ...paragraphs(t("busy.text")), left);
    for (let seconds = Math.ceil(ms / 1000); seconds > 0; seconds--) {
      left.textContent = t("busy.again", { seconds });
      await sleep(1000);
      if (!page.isConnected) return;
    }
  };
}

/**
 * Render a page with heading and text and, if given, further elements and a main and a secondary
 * button.
 * @param {{title: string, text: string, parts?: HTMLElement[],
 *   action?: {label: string, run: () => void}|null,
 *   quiet?: {label: string, run: () => void}|null}} content
 * @returns {(page: HTMLElement) => void}
 */
export function messagePage({ title, text, parts = [], action = null, quiet = null }) {
  return (page) => {
    page.append(el("h1", {}, title), ...paragraphs(text), ...parts);
    const buttons = [
      quiet && button(quiet.label, quiet.run, { class: "button quiet" }),
      action && button(action.label, action.run),
    ].filter(Boolean);
    if (buttons.length > 0) page.append(el("div", { class: "buttons" }, ...buttons));
  };
}

/**
 * Render the page shown before a trial while the window is too small.
 * @param {Context} context
 * @param {() => boolean} fits
 * @returns {Render}
 */
export function windowPage({ texts, study, address }, fits) {
  const { t } = bound(texts);
  return (page, done, signal) => {
    const text = el("p", { role: "alert" });
    const check = () => {
      text.textContent = t("window.text", {
        width: study.min_width,
        height: study.min_height,
        now_width: window.innerWidth,
        now_height: window.innerHeight,
      });
      if (fits()) done();
    };
    page.append(el("h1", {}, t("window.title")), text);
    if (window.top !== window.self) {
      const link = { href: address, target: "_blank", rel: "noopener" };
      page.append(el("p", {}, el("a", link, t("window.open_alone"))));
    }
    window.addEventListener("resize", check, { signal });
    check();
  };
}
