/**
 * Header and status line around the pages: title, progress, language, stop button and connection.
 * @module frame
 */

import { button, el } from "./dom.js";

/** Stages in which there is nothing to stop: not begun yet, or finished. */
const WITHOUT_STOP_BUTTON = ["consent", "done"];
const BACK_SHOWN_MS = 4_000;

const byId = (id) => document.getElementById(id);

/** The header and status line of the page. */
export class Frame {
  /**
   * @param {import("./messages.js").PublicStudy} study
   * @param {import("./texts.js").Texts} texts
   */
  constructor(study, texts) {
    this.study = study;
    this.main = byId("main");
    /** @type {() => void} */
    this.onStop = () => {};
    /** @type {(to: {stage: string, trial: number}) => void} */
    /** @type {(language: string) => void} */
    this.onLanguage = () => {};
    /** @type {import("./messages.js").SessionState|null} */
    this.state = null;
    this.setTexts(texts);
  }

  /** Use these texts from now on. @param {import("./texts.js").Texts} texts */
  setTexts(texts) {
    this.texts = texts;
    document.documentElement.lang = texts.language;
    this.#showTitle();
    byId("skip").textContent = texts.t("common.skip");
    byId("skip").hidden = false;
  }

  /**
   * Show the controls of the session's stage.
   * @param {{state: import("./messages.js").SessionState}} context
   */
  show({ state }) {
    this.state = state;
    const inTrials = state.stage === "familiarization" || state.stage === "test";
    document.body.classList.toggle("in-trials", inTrials);
    byId("progress").hidden = !inTrials;
    const tools = [];
    if (state.stage === "consent") tools.push(this.languageChooser());
    if (!state.ended && !WITHOUT_STOP_BUTTON.includes(state.stage)) {
      const stop = button(this.texts.t("stop.open"), () => this.onStop(), { class: "link" });
      tools.push(stop);
    }
    byId("tools").replaceChildren(...tools);
    this.#showTitle();
  }

  /** Show the title of the study, in the words of the language and scenario if they have some. */
  #showTitle() {
    const title = this.texts.has("study.title") ? this.texts.t("study.title") : this.study.title;
    document.title = title;
    document.body.classList.toggle("is-preview", this.state?.kind === "preview");
    const preview = this.state?.kind === "preview" ? [this.texts.t("common.preview")] : [];
    byId("title").textContent = [title, ...preview].join(" · ");
  }

  /**
   * Show the progress when a trial begins.
   * @param {import("./messages.js").Phase} phase @param {number} trial
   */
  progress(phase, trial) {
    const { state, texts } = this;
    const trials = state.trials[phase];
    const key = phase === "test" ? "common.progress" : "common.practice_progress";
    const text = texts.t(key, { trial: trial + 1, trials });
    byId("progress").replaceChildren(
      el("label", { for: "bar" }, text),
      el("progress", { id: "bar", max: trials, value: trial }),
    );
  }

  /** Create the select box of languages. @returns {HTMLElement} */
  languageChooser() {
    const { languages } = this.study;
    if (languages.length < 2) return el("span");
    const name = (tag) => new Intl.DisplayNames([tag], { type: "language" }).of(tag);
    const options = languages.map((tag) =>
      el("option", { value: tag, lang: tag, selected: tag === this.texts.language }, name(tag)),
    );
    const select = el("select", { id: "language" }, ...options);
    select.addEventListener("change", () => this.onLanguage(select.value));
    const label = el("label", { for: "language" }, this.texts.t("language.choose"));
    return el("span", { class: "language" }, label, select);
  }

  /**
   * Show how requests fail, or for a while that they work again.
   * @param {"lost"|"busy"|null} trouble
   */
  connection(trouble) {
    const status = byId("status");
    clearTimeout(this.timer);
    status.textContent = this.texts.t(`connection.${trouble ?? "back"}`);
    status.classList.toggle("status-lost", trouble !== null);
    if (!trouble) this.timer = setTimeout(() => (status.textContent = ""), BACK_SHOWN_MS);
  }
}
