/**
 * Pages with forms: the comprehension check, demographics, the lab's own questions, feedback.
 * @module forms
 */

import { el, paragraphs } from "./dom.js";
import { bound } from "./texts.js";

/**
 * A field of a form: its element, its value, and whether the value may be sent.
 * @typedef {{element: HTMLElement, value: () => any, check: () => boolean, focus: () => void}} Field
 */

/** Create a form. @param {() => void} send Called when it is submitted. */
export function form(send, ...children) {
  const element = el("form", { novalidate: true }, ...children);
  element.addEventListener("submit", (event) => {
    event.preventDefault();
    send();
  });
  return element;
}

/**
 * Create a form of questions with their names; its values are sent once all may be.
 * @param {Array<[string, Field]>} named
 * @param {string} label Label of the button.
 * @param {(values: Record<string, any>) => void} send
 */
export function questionForm(named, label, send) {
  const fields = named.map(([, each]) => each);
  const sent = () => {
    if (complete(fields)) send(Object.fromEntries(named.map(([name, each]) => [name, each.value()])));
  };
  const button = el("div", { class: "buttons" }, submit(label));
  return form(sent, ...fields.map((each) => each.element), button);
}

/** Create the button that submits a form. @param {string} label */
export function submit(label) {
  return el("button", { type: "submit", class: "button" }, label);
}

/** Create a labelled control. */
export function field(id, label, control, ...more) {
  return el("div", { class: "field" }, el("label", { for: id }, label), control, ...more);
}

/**
 * Return the fields that may not be sent yet, each with its message, and focus the first of them.
 * @param {Field[]} fields
 * @returns {boolean} Whether all may be sent.
 */
export function complete(fields) {
  const missing = fields.filter((each) => !each.check());
  missing[0]?.focus();
  return missing.length === 0;
}

/**
 * Create a field for a text.
 * @param {string} name @param {string} question
 * @param {{most: number, required: string|null}} options `required`: the message if it is empty.
 * @returns {Field}
 */
export function textField(name, question, { most, required }) {
  const control = el("textarea", { id: name, rows: 3, maxlength: most });
  const wrong = message(name, control);
  control.addEventListener("input", () => wrong.show(""));
  return {
    element: field(name, question, control, wrong.element),
    value: () => control.value.trim() || null,
    focus: () => control.focus(),
    check: () => wrong.show(required && !control.value.trim() ? required : ""),
  };
}

/**
 * Create a group of radio buttons, or of boxes of which any number can be ticked.
 * @param {string} name @param {string} question
 * @param {Array<[string, string]>} choices Values and labels.
 * @param {{required: string|null, several?: boolean, style?: string}} options `required`: the message
 *   if nothing is chosen; `style`: class of the row.
 * @returns {Field} Its value is a value or null; of boxes, a list.
 */
export function choiceField(name, question, choices, { required, several = false, style = "" }) {
  const type = several ? "checkbox" : "radio";
  const inputs = choices.map(([value]) => el("input", { type, name, value, id: `${name}-${value}` }));
  const labels = choices.map(([value, label], index) =>
    el("label", { class: "radio", for: `${name}-${value}` }, inputs[index], label),
  );
  const row = el("div", { class: `radios ${style}`.trim() }, ...labels);
  const element = el("fieldset", several ? {} : { role: "radiogroup" }, el("legend", {}, question), row);
  const wrong = message(name, element);
  element.append(wrong.element);
  element.addEventListener("change", () => wrong.show(""));
  const chosen = () => inputs.filter((input) => input.checked).map((input) => input.value);
  return {
    element,
    value: () => (several ? chosen() : chosen()[0] || null),
    focus: () => inputs[0].focus(),
    check: () => wrong.show(required && chosen().length === 0 ? required : ""),
  };
}

/** Create the place of a message about a control, empty while all is well. */
function message(name, control) {
  const element = el("p", { class: "wrong", id: `${name}-wrong`, role: "alert" });
  control.setAttribute("aria-describedby", element.id);
  return {
    element,
    /** Show a text, or none; return whether there is none. @param {string} text */
    show(text) {
      element.textContent = text;
      control.setAttribute("aria-invalid", String(text !== ""));
      return text === "";
    },
  };
}

const GENDERS = ["female", "male", "other"];
const EDUCATIONS = [
  "none",
  "secondary",
  "vocational",
  "some_college",
  "bachelor",
  "master",
  "doctorate",
];
const AGES = [18, 120];

/**
 * Render the demographics page: age, gender and education, all optional.
 * @param {import("./pages.js").Context} context
 * @returns {import("./pages.js").Render}
 */
export function demographicsPage({ texts }) {
  const { t } = bound(texts);
  return (page, done) => {
    const age = el("input", { id: "age", type: "text", inputmode: "numeric", maxlength: 3 });
    age.autocomplete = "off";
    const wrong = el("p", { class: "wrong", id: "age-wrong", role: "alert" });
    age.setAttribute("aria-describedby", "age-wrong");
    const choice = (name, options) => selectOf(name, options, t);
    const gender = choice("gender", GENDERS);
    const education = choice("education", EDUCATIONS);
    const check = (isWrong) => {
      wrong.textContent = isWrong ? t("demographics.age_wrong") : "";
      age.setAttribute("aria-invalid", String(isWrong));
    };
    age.addEventListener("input", () => Number.isNaN(readAge(age.value)) || check(false));
    const send = () => {
      const years = readAge(age.value);
      check(Number.isNaN(years));
      if (Number.isNaN(years)) return age.focus();
      return done({ age: years, gender: gender.value, education: education.value });
    };
    page.append(
      el("h1", {}, t("demographics.title")),
      ...paragraphs(t("demographics.text")),
      form(
        send,
        field("age", t("demographics.age"), age, wrong),
        field("gender", t("demographics.gender"), gender),
        field("education", t("demographics.education"), education),
        el("div", { class: "buttons" }, submit(t("demographics.send"))),
      ),
    );
  };
}

/**
 * Render the feedback page: difficulty, technical problems and free text.
 * @param {import("./pages.js").Context} context
 * @returns {import("./pages.js").Render}
 */
export function feedbackPage({ texts }) {
  const { t } = bound(texts);
  const required = t("common.required");
  const [levels, problems] = [[1, 2, 3, 4, 5], ["yes", "no"]];
  return (page, done) => {
    const difficulty = choiceField(
      "difficulty",
      t("feedback.difficulty"),
      levels.map((value) => [String(value), t(`feedback.difficulty_${value}`)]),
      { required, style: "radios-5" },
    );
    const technical = choiceField(
      "technical",
      t("feedback.technical"),
      problems.map((value) => [value, t(`feedback.technical_${value}`)]),
      { required },
    );
    const text = textField("text", t("feedback.text"), { most: 5000, required: null });
    const send = () => {
      if (!complete([difficulty, technical])) return;
      done({
        difficulty: Number(difficulty.value()),
        technical_problems: technical.value() === "yes",
        text: text.value() ?? "",
      });
    };
    page.append(
      el("h1", {}, t("feedback.title")),
      form(
        send,
        difficulty.element,
        technical.element,
        text.element,
        el("div", { class: "buttons" }, submit(t("feedback.send"))),
      ),
    );
  };
}

/**
 * Return the age in years, null if the text is empty, NaN if it is not a valid age.
 * @param {string} text
 * @returns {number|null}
 */
function readAge(text) {
  if (text.trim() === "") return null;
  const years = /^\d{1,3}$/.test(text.trim()) ? Number(text) : NaN;
  return years >= AGES[0] && years <= AGES[1] ? years : NaN;
}

/** Create a select box with an empty first option. */
function selectOf(name, values, t) {
  const options = [
    el("option", { value: "" }, t("demographics.no_answer")),
    ...values.map((value) => el("option", { value }, t(`demographics.${name}_${value}`))),
  ];
  return el("select", { id: name }, ...options);
}

/**
 * Render the comprehension check; all questions must be answered.
 * @param {import("./pages.js").Context} context
 * @returns {import("./pages.js").Render}
 */
export function comprehensionPage({ texts, study }) {
  const { t } = bound(texts);
  const required = t("common.required");
  return (page, done) => {
    /** @type {Array<[string, Field]>} */
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

const MAX_LENGTH = 2000;

/** @typedef {import("./messages.js").AskedQuestion} AskedQuestion */
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
function fieldOf(question, t) {
  const made = controlOf(question, t);
  const { name, picture } = question;
  if (!picture) return made;
  const image = { src: `/picture/${encodeURIComponent(picture)}`, alt: t(`question.${name}.alt`) };
  // A fieldset has its question as legend, a text its label.
  made.element.querySelector("legend, label").after(el("img", { class: "question-picture", ...image }));
  return made;
}

/** Create the control of a question. @returns {Field} */
function controlOf({ name, kind, required, options, steps }, t) {
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
