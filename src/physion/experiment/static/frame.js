/**
 * What stands around the pages: title, progress, language, the way out, and word of the connection.
 * @module frame
 */

import { button, el } from "./dom.js";

const STAGES_WITH_WAY_OUT = [
  "instructions",
  "familiarization",
  "ready",
  "test",
  "demographics",
  "feedback",
];
const BACK_SHOWN_MS = 4_000;

const byId = (id) => document.getElementById(id);

export class Frame {
  /** @param {any} study `PublicStudy` @param {import("./texts.js").Texts} texts */
  constructor(study, texts) {
    this.study = study;
    this.main = byId("main");
    this.onStop = () => {};
    /** @type {(language: string) => void} */
    this.onLanguage = () => {};
    this.state = null;
    this.speak(texts);
  }

  /** Use these texts from now on. */
  speak(texts) {
    this.texts = texts;
    document.documentElement.lang = texts.language;
    document.title = this.study.title;
    byId("title").textContent = this.study.title;
    byId("skip").textContent = texts.t("common.skip");
    byId("skip").hidden = false;
  }

  /** Show what belongs to a stage of the session. @param {{state: any}} context */
  show({ state }) {
    this.state = state;
    const inTrials = state.stage === "familiarization" || state.stage === "test";
    document.body.classList.toggle("in-trials", inTrials);
    byId("progress").hidden = !inTrials;
    const tools = [];
    if (state.stage === "consent") tools.push(this.languageChooser());
    if (STAGES_WITH_WAY_OUT.includes(state.stage)) {
      const stop = button(this.texts.t("stop.open"), () => this.onStop(), { class: "link" });
      tools.push(stop);
    }
    byId("tools").replaceChildren(...tools);
    const title = [this.study.title];
    if (state.kind === "preview") title.push(this.texts.t("common.preview"));
    byId("title").textContent = title.join(" · ");
  }

  /** The trial that begins. @param {"familiarization"|"test"} phase @param {number} trial */
  progress(phase, trial) {
    const trials = this.state.trials[phase];
    const key = phase === "test" ? "common.progress" : "common.practice_progress";
    const text = this.texts.t(key, { trial: trial + 1, trials });
    byId("progress").replaceChildren(
      el("label", { for: "bar" }, text),
      el("progress", { id: "bar", max: trials, value: trial }),
    );
  }

  /** @returns {HTMLElement} */
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

  /** Say how requests fail, or that they do no more. @param {"lost"|"busy"|null} trouble */
  connection(trouble) {
    const status = byId("status");
    clearTimeout(this.timer);
    status.textContent = this.texts.t(`connection.${trouble ?? "back"}`);
    status.classList.toggle("status-lost", trouble !== null);
    if (!trouble) this.timer = setTimeout(() => (status.textContent = ""), BACK_SHOWN_MS);
  }
}
