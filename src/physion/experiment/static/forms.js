/**
 * Pages with forms: demographics and feedback.
 * @module forms
 */

import { el, paragraphs } from "./dom.js";
import { bound } from "./texts.js";

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
  return (page, done) => {
    const difficulty = radios(
      "difficulty",
      t("feedback.difficulty"),
      [1, 2, 3, 4, 5].map((value) => [value, t(`feedback.difficulty_${value}`)]),
      t,
    );
    const technical = radios(
      "technical",
      t("feedback.technical"),
      [
        ["yes", t("feedback.technical_yes")],
        ["no", t("feedback.technical_no")],
      ],
      t,
    );
    const text = el("textarea", { id: "text", rows: 3, maxlength: 5000 });
    const send = () => {
      const missing = [difficulty, technical].filter((group) => !group.check());
      if (missing.length > 0) return missing[0].focus();
      return done({
        difficulty: Number(difficulty.value()),
        technical_problems: technical.value() === "yes",
        text: text.value,
      });
    };
    page.append(
      el("h1", {}, t("feedback.title")),
      form(
        send,
        difficulty.element,
        technical.element,
        field("text", t("feedback.text"), text),
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

function form(send, ...children) {
  const element = el("form", { novalidate: true }, ...children);
  element.addEventListener("submit", (event) => {
    event.preventDefault();
    send();
  });
  return element;
}

function submit(label) {
  return el("button", { type: "submit", class: "button" }, label);
}

function field(id, label, control, ...more) {
  return el("div", { class: "field" }, el("label", { for: id }, label), control, ...more);
}

/** Create a select box with an empty first option. */
function selectOf(name, values, t) {
  const options = [
    el("option", { value: "" }, t("demographics.no_answer")),
    ...values.map((value) => el("option", { value }, t(`demographics.${name}_${value}`))),
  ];
  return el("select", { id: name }, ...options);
}

/** Create a group of radio buttons of which one must be chosen. */
function radios(name, question, choices, t) {
  const wrong = el("p", { class: "wrong", id: `${name}-wrong`, role: "alert" });
  const inputs = choices.map(([value]) =>
    el("input", { type: "radio", name, value, id: `${name}-${value}` }),
  );
  const labels = choices.map(([value, label], index) =>
    el("label", { class: "radio", for: `${name}-${value}` }, inputs[index], label),
  );
  const row = el("div", { class: `radios radios-${choices.length}` }, ...labels);
  const described = { role: "radiogroup", "aria-describedby": wrong.id };
  const element = el("fieldset", described, el("legend", {}, question), row, wrong);
  const chosen = () => inputs.find((input) => input.checked);
  const showError = (text) => {
    wrong.textContent = text;
    element.setAttribute("aria-invalid", String(text !== ""));
  };
  element.addEventListener("change", () => showError(""));
  return {
    element,
    value: () => chosen()?.value ?? "",
    focus: () => inputs[0].focus(),
    check() {
      showError(chosen() ? "" : t("common.required"));
      return Boolean(chosen());
    },
  };
}
