/**
 * The questions about the instructions. Only the server knows whether an answer is right.
 * @module comprehension_page
 */

import { el, paragraphs } from "./dom.js";
import { choiceField, questionForm } from "./form_fields.js";
import { bound } from "./texts.js";

/**
 * Render the comprehension check; all questions must be answered.
 * @param {import("./pages.js").Context} context
 * @returns {import("./pages.js").Render}
 */
export function comprehensionPage({ texts, study }) {
  const { t } = bound(texts);
  const required = t("common.required");
  return (page, done) => {
    /** @type {Array<[string, import("./form_fields.js").Field]>} */
    const fields = study.comprehension_questions.map(({ name, options }) => {
      const own = (key) => t(`comprehension_question.${name}.${key}`);
      /** @type {Array<[string, string]>} */
      const choices = options.map((option) => [option, own(`options.${option}`)]);
      return [name, choiceField(`c-${name}`, own("text"), choices, { required, style: "radios-list" })];
    });
    page.append(
      el("h1", {}, t("comprehension.title")),
      ...paragraphs(t("comprehension.text")),
      questionForm(fields, t("comprehension.send"), done),
    );
  };
}

/**
 * Return what stands above the instructions after a wrong attempt; nothing before the first one.
 * @param {import("./pages.js").Context} context
 * @returns {HTMLElement[]}
 */
export function wrongAttempt({ texts, study, state }) {
  const { comprehension_attempts: attempts } = state;
  if (attempts === 0) return [];
  const left = study.comprehension_limit - attempts;
  return [el("p", { class: "notice", role: "alert" }, texts.t("comprehension.again", { left }))];
}
