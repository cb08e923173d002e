/**
 * The page with the lab's own questions.
 * @module question_page
 */

import { el, paragraphs } from "./dom.js";
import { choiceField, complete, form, submit, textField } from "./form_fields.js";
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
    const fields = study.questions.map((question) => fieldOf(question, t));
    const send = () => {
      if (!complete(fields)) return;
      const named = study.questions.map(({ name }, index) => [name, fields[index].value()]);
      done(Object.fromEntries(named));
    };
    page.append(
      el("h1", {}, t("questions.title")),
      ...paragraphs(t("questions.text")),
      form(
        send,
        ...fields.map((each) => each.element),
        el("div", { class: "buttons" }, submit(t("questions.send"))),
      ),
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
  if (kind === "scale") return scaleField(id, words, { needed, steps, ends: [own("low"), own("high")] });
  /** @type {Array<[string, string]>} */
  const choices = options.map((option) => [option, own(`options.${option}`)]);
  const several = kind === "choices";
  // A radio button cannot be cleared again.
  if (!several && !required) choices.push(["", t("demographics.no_answer")]);
  return choiceField(id, words, choices, { required: needed, several, style: "radios-list" });
}

/** Create a scale: numbered steps with a label at either end. @returns {Field} */
function scaleField(id, words, { needed, steps, ends }) {
  /** @type {Array<[string, string]>} */
  const choices = Array.from({ length: steps }, (_, index) => [String(index + 1), String(index + 1)]);
  const scale = choiceField(id, words, choices, { required: needed, style: "scale" });
  const [low, high] = ends;
  const labels = el(
    "div",
    { class: "scale-ends small", id: `${id}-ends` },
    el("span", {}, low),
    el("span", {}, high),
  );
  scale.element.querySelector(".scale").after(labels);
  scale.element.setAttribute("aria-describedby", `${id}-ends ${id}-wrong`);
  const chosen = () => scale.value();
  return { ...scale, value: () => (chosen() === null ? null : Number(chosen())) };
}
