/**
 * The page with the lab's own questions.
 * @module question_page
 */

import { el, paragraphs } from "./dom.js";
import { choiceField, questionForm, textField } from "./form_fields.js";
import { bound } from "./texts.js";

const MAX_LENGTH = 2000;

/** @typedef {import("./messages.js").AskedQuestion} AskedQuestion */
/** @typedef {import("./form_fields.js").Field} Field */

/**
 * Render the questions of the lab; required ones must be answered.
 * @param {import("./pages.js").Context} context
 * @returns {import("./pages.js").Render}
 */
export function questionPage({ texts, study }) {
  const { t } = bound(texts);
  return (page, done) => {
    /** @type {Array<[string, Field]>} */
    const fields = study.questions.map((question) => [question.name, fieldOf(question, t)]);
    page.append(
      el("h1", {}, t("questions.title")),
      ...paragraphs(t("questions.text")),
      questionForm(fields, t("questions.send"), done),
    );
  };
}

/**
 * Create the field of a question.
 * @param {AskedQuestion} question
 * @param {(key: string, values?: Record<string, any>) => string} t
 * @returns {Field}
 */
function fieldOf({ name, kind, required, options, steps }, t) {
  const own = (key) => t(`question.${name}.${key}`);
  const words = required ? own("text") : `${own("text")} ${t("questions.optional")}`;
  const needed = required ? t("common.required") : null;
  const id = `q-${name}`;
  if (kind === "text") return textField(id, words, { most: MAX_LENGTH, required: needed });
  // A radio button cannot be cleared again.
  const none = required ? null : t("demographics.no_answer");
  if (kind === "scale") return scaleField(id, words, { needed, steps, none, ends: [own("low"), own("high")] });
  /** @type {Array<[string, string]>} */
  const choices = options.map((option) => [option, own(`options.${option}`)]);
  const several = kind === "choices";
  if (!several && none) choices.push(["", none]);
  return choiceField(id, words, choices, { required: needed, several, style: "radios-list" });
}

/**
 * Create a scale: numbered steps with a label at either end, and below them the choice of no answer
 * where `none` is its label.
 * @returns {Field}
 */
function scaleField(id, words, { needed, steps, none, ends }) {
  /** @type {Array<[string, string]>} */
  const choices = Array.from({ length: steps }, (_, index) => [String(index + 1), String(index + 1)]);
  if (none) choices.push(["", none]);
  const scale = choiceField(id, words, choices, { required: needed, style: "scale" });
  const [low, high] = ends;
  const labels = el(
    "div",
    { class: "scale-ends small", id: `${id}-ends` },
    el("span", {}, low),
    el("span", {}, high),
  );
  scale.element.querySelector(".scale").after(labels);
  if (none) labels.after(scale.element.querySelector(".radio:last-child"));
  scale.element.setAttribute("aria-describedby", `${id}-ends ${id}-wrong`);
  const chosen = () => scale.value();
  return { ...scale, value: () => (chosen() === null ? null : Number(chosen())) };
}
