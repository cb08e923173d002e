/**
 * The last page: accuracy, percentile and how to get the credit.
 * @module result_page
 */

import { completionParts } from "./completion.js";
import { button, el } from "./dom.js";
import { bound } from "./texts.js";

/**
 * Render the result page.
 * @param {import("./pages.js").Context} context
 * @param {import("./messages.js").Result} result
 * @returns {(page: HTMLElement) => void}
 */
export function resultPage({ texts, study, state, another }, result) {
  const { t } = bound(texts);
  const percent = number(texts, 100 * result.accuracy);
  const { correct, trials, percentile, completion } = result;
  return (page) => {
    page.append(
      el("h1", {}, t("result.title")),
      el("p", {}, t("result.accuracy", { correct, trials, percent })),
    );
    if (percentile !== null) {
      const rounded = number(texts, percentile);
      page.append(el("p", {}, t("result.percentile", { percentile: rounded })));
    }
    page.append(el("p", {}, t("result.saved")));
    if (completion.withheld) {
      const { contact } = study;
      page.append(el("p", { id: "withheld" }, t("result.withheld", { contact })));
    }
    page.append(...completionParts(completion, t, "result.go_hint"));
    const contact = t("result.contact", { contact: study.contact });
    const reference = t("common.reference", { reference: state.reference });
    page.append(el("p", { class: "small" }, `${contact} · ${reference}`));
    if (!another) return;
    const next = button(t("common.another_person"), another, { class: "button quiet" });
    page.append(el("div", { class: "buttons" }, next));
  };
}

/** Format a number without decimals in the language of the texts. */
const number = (texts, value) =>
  new Intl.NumberFormat(texts.language, { maximumFractionDigits: 0 }).format(value);
