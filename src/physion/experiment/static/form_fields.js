/**
 * Parts of the pages with forms: fields, groups of radio buttons and boxes, scales.
 * @module form_fields
 */

import { el } from "./dom.js";

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
