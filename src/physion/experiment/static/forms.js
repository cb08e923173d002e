/**
 * Pages with forms: demographics and feedback.
 * @module forms
 */

import { el, paragraphs } from "./dom.js";
import { choiceField, complete, field, form, submit, textField } from "./form_fields.js";
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
