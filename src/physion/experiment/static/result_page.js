/**
 * The last page: accuracy, percentile and how to get the credit.
 * @module result_page
 */

import { button, el } from "./dom.js";
import { bound } from "./pages.js";

/** Hosts of MTurk and its sandbox. */
const MTURK = ["www.mturk.com", "workersandbox.mturk.com"];

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
    if (completion.code) page.append(codeBox(completion.code, t));
    if (completion.url) page.append(el("p", {}, t("result.go_hint")), wayBack(completion, t));
    else page.append(el("p", {}, t("result.close")));
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

/** Create the box with the completion code and a button that copies it. */
function codeBox(code, t) {
  const shown = el("output", { class: "code", id: "code", tabindex: "0" }, code);
  const status = el("span", { role: "status", class: "small" });
  const copyButton = button(t("result.copy"), async () => {
    status.textContent = t((await copy(code, shown)) ? "result.copied" : "result.copy_failed");
  });
  copyButton.classList.add("quiet");
  const label = el("label", { for: "code" }, t("result.code"));
  return el("div", { class: "code-box" }, label, shown, copyButton, status);
}

/** Copy the code; select it if the clipboard is not available (without HTTPS). */
async function copy(code, shown) {
  try {
    await navigator.clipboard.writeText(code);
    return true;
  } catch {
    window.getSelection().selectAllChildren(shown);
    return document.execCommand("copy");
  }
}

/** Create a link back to the recruiter, or the form of MTurk. Only http(s) URLs are accepted. */
function wayBack({ url, post }, t) {
  const web = /^https?:\/\//i.test(url);
  if (!web || (post && !isMTurk(url))) return el("p", {}, t("result.close"));
  if (!post) {
    const link = { class: "button", href: url, rel: "noreferrer", id: "go" };
    return el("div", { class: "buttons" }, el("a", link, t("result.go")));
  }
  const fields = Object.entries(post).map(([name, value]) =>
    el("input", { type: "hidden", name, value }),
  );
  const send = el("button", { type: "submit", class: "button", id: "go" }, t("result.go"));
  // Sent within MTurk's frame, as in its documentation of ExternalQuestion.
  return el(
    "form",
    { method: "post", action: url },
    ...fields,
    el("div", { class: "buttons" }, send),
  );
}

/** Return whether a URL is MTurk's address for submitted tasks. @param {string} url */
function isMTurk(url) {
  const { protocol, host, pathname } = new URL(url);
  return protocol === "https:" && MTURK.includes(host) && pathname === "/mturk/externalSubmit";
}
