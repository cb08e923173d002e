/**
 * Pages of participants who do not finish: the questions whether to decline and to stop, and the
 * page after it.
 * @module ending_pages
 */

import { completionParts } from "./completion.js";
import { button, el, paragraphs } from "./dom.js";
import { bound } from "./texts.js";

/** @typedef {import("./pages.js").Context} Context */
/** @typedef {import("./pages.js").Render} Render */

/** Render the question whether to decline; ends with {declined}. @param {Context} context */
export function declineQuestion({ texts }) {
  const { t } = bound(texts);
  return question(t, "decline", t("decline.text"), [], (declined) => ({ declined }));
}

/** Render the question whether to stop; ends with {stop}. @param {Context} context */
export function stopQuestion({ texts, study, state }) {
  const { t } = bound(texts);
  const text = t("stop.text", { contact: study.contact });
  const reference = t("common.reference", { reference: state.reference });
  const parts = [el("p", { class: "small" }, reference)];
  return question(t, "stop", text, parts, (stop) => ({ stop }));
}

/**
 * Render a question whose main button continues the study and whose other button ends it.
 * @param {(key: string) => string} t
 * @param {string} name Table of the texts `title`, `confirm` and `go_on`.
 * @param {string} text
 * @param {HTMLElement[]} parts Elements after the text.
 * @param {(ends: boolean) => any} answerOf
 * @returns {Render}
 */
function question(t, name, text, parts, answerOf) {
  return (page, done) =>
    page.append(
      el("h1", {}, t(`${name}.title`)),
      ...paragraphs(text),
      ...parts,
      el(
        "div",
        { class: "buttons" },
        button(t(`${name}.confirm`), () => done(answerOf(true)), { class: "button quiet" }),
        button(t(`${name}.go_on`), () => done(answerOf(false))),
      ),
    );
}

/**
 * Render the page of a session that ended early, with the texts of its stage.
 * @param {Context} context
 * @param {import("./messages.js").SessionEnd} ending
 * @returns {(page: HTMLElement) => void}
 */
export function endedPage({ texts, study, state, another, address }, { completion }) {
  const { t } = bound(texts);
  const submitted = completion.code || completion.url;
  const declined = state.stage === "declined"; // nothing was stored
  const takePart = () => window.location.replace(address);
  const changed = () => {
    const control = button(t("ended.take_back"), takePart, { class: "button quiet" });
    return el("p", { class: "apart" }, t("ended.mind_changed"), " ", control);
  };
  const reference = t("common.reference", { reference: state.reference });
  return (page) => {
    page.append(
      el("h1", {}, t(`${state.stage}.title`)),
      ...paragraphs(t(`${state.stage}.text`, study)),
      ...(submitted ? [] : [el("p", {}, t("ended.return_submission"))]),
      ...completionParts(completion, t, "ended.go_hint"),
      declined ? changed() : el("p", { class: "small" }, reference),
    );
    if (!another) return;
    const next = button(t("common.another_person"), another, { class: "button quiet" });
    page.append(el("div", { class: "buttons" }, next));
  };
}
