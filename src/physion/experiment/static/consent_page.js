/**
 * The consent page: the text, a file, boxes to tick, and the decision.
 * @module consent_page
 */

import { button, el, paragraphs } from "./dom.js";
import { declineQuestion } from "./ending_pages.js";
import { ask } from "./page_trial.js";
import { minutes } from "./pages.js";
import { bound } from "./texts.js";

const MOST_BOXES = 9;

/**
 * Render the consent page. All boxes must be ticked to agree; who does not agree is asked once more.
 * @param {import("./pages.js").Context} context
 * @returns {import("./pages.js").Render}
 */
export function consentPage(context) {
  const { texts, study, state } = context;
  const { t } = bound(texts);
  const { familiarization, test } = state.trials;
  const lasting = study.expected_minutes || minutes(study, familiarization, test);
  const values = { trials: familiarization + test, minutes: lasting, contact: study.contact };
  return (page, done, signal) => {
    const boxes = consentBoxes(texts);
    const decline = async () => {
      const answer = await ask(declineQuestion(context), signal);
      if (answer?.declined) done({ agreed: false });
    };
    page.append(
      el("h1", {}, t("consent.title")),
      ...paragraphs(t("consent.text", values)),
      ...payment(study, texts, lasting),
      ...(study.funders ? paragraphs(t("consent.funders", { funders: study.funders })) : []),
      ...consentFile(study, texts),
      ...boxes.elements,
      el("p", { class: "small" }, t("consent.version", { version: study.consent_version })),
      el(
        "div",
        { class: "buttons" },
        button(t("consent.decline"), decline, { class: "button quiet" }),
        button(t("consent.agree"), () => boxes.check() && done({ agreed: true })),
      ),
    );
  };
}

/** Return the paragraph about the payment, with the wage per hour; nothing without payment. */
function payment({ payment: paid }, texts, lasting) {
  if (!paid) return [];
  const amount = money(paid.amount, paid.currency, texts.language);
  const hourly = money((60 * paid.amount) / lasting, paid.currency, texts.language);
  return paragraphs(texts.t("consent.payment", { amount, hourly, minutes: lasting }));
}

/** Format an amount in a language; the currency is a code such as USD, or words. */
function money(amount, currency, language) {
  const digits = { minimumFractionDigits: amount % 1 ? 2 : 0, maximumFractionDigits: 2 };
  if (!/^[A-Z]{3}$/.test(currency)) {
    return `${new Intl.NumberFormat(language, digits).format(amount)} ${currency}`;
  }
  return new Intl.NumberFormat(language, { style: "currency", currency }).format(amount);
}

/** Return the link to the consent form as a file, if the study has one in this language. */
function consentFile(study, texts) {
  if (!study.consent_files.includes(texts.language)) return [];
  const href = `/consent/${encodeURIComponent(texts.language)}.pdf`;
  const link = el("a", { href, target: "_blank", rel: "noopener" }, texts.t("consent.file"));
  return [el("p", {}, link)];
}

/** Create the boxes of the texts `consent.check_1` and so on. */
function consentBoxes(texts) {
  const { t } = bound(texts);
  const numbers = Array.from({ length: MOST_BOXES }, (_, index) => index + 1);
  const keys = numbers.map((number) => `consent.check_${number}`).filter((key) => texts.has(key));
  const inputs = keys.map(() => el("input", { type: "checkbox" }));
  const labels = keys.map((key, index) => el("label", { class: "check" }, inputs[index], t(key)));
  const wrong = el("p", { class: "wrong", role: "alert" });
  const missing = () => inputs.find((input) => !input.checked);
  for (const input of inputs) {
    input.addEventListener("change", () => {
      if (!missing()) wrong.textContent = "";
    });
  }
  return {
    elements: inputs.length > 0 ? [...labels, wrong] : [],
    check() {
      wrong.textContent = missing() ? t("consent.check_missing") : "";
      missing()?.focus();
      return !missing();
    },
  };
}
