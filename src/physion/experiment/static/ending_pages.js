/**
 * The pages at the end of a session: the result, early ends, and how to get the credit.
 * @module ending_pages
 */

import { button, el, paragraphs } from "./dom.js";
import { bound } from "./texts.js";

/** Hosts of MTurk and its sandbox. */
const MTURK = ["www.mturk.com", "workersandbox.mturk.com"];

/**
 * Create the code box and the way back to the recruiter; without a way back, say that the window can
 * be closed.
 * @param {import("./messages.js").Completion} completion
 * @param {(key: string, values?: Record<string, any>) => string} t
 * @param {string} hint Key of the text above the way back.
 * @returns {HTMLElement[]}
 */
export function completionParts(completion, t, hint) {
  const { code, url } = completion;
  const back = url
    ? [el("p", {}, t(hint)), wayBack(completion, t)]
    : [el("p", {}, t("result.close"))];
  return [...(code ? [codeBox(code, t)] : []), ...back];
}

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

/** @typedef {import("./pages.js").Context} Context */
/** @typedef {import("./pages.js").Render} Render */

/** Render the question whether to decline; ends with {declined}. @param {Context} context */
export function declineQuestion({ texts }) {
  const { t } = bound(texts);
  return question(t, "decline", t("decline.text"), [], (declined) => ({ declined }));
}

/** Render the question whether to stop; ends with {stop}. @param {Context} context */
export function stopQuestion({ texts, study, state }) {
  const { t } = bound(texts);
  const text = t("stop.text", { contact: study.contact });
  const reference = t("common.reference", { reference: state.reference });
  const parts = [el("p", { class: "small" }, reference)];
  return question(t, "stop", text, parts, (stop) => ({ stop }));
}

/**
 * Render a question whose main button continues with the study and whose other button ends it.
 * @param {(key: string) => string} t
 * @param {string} name Table of the texts `title`, `confirm` and `go_on`.
 * @param {string} text
 * @param {HTMLElement[]} parts Elements after the text.
 * @param {(ends: boolean) => any} answerOf
 * @returns {Render}
 */
function question(t, name, text, parts, answerOf) {
  return (page, done) =>
    page.append(
      el("h1", {}, t(`${name}.title`)),
      ...paragraphs(text),
      ...parts,
      el(
        "div",
        { class: "buttons" },
        button(t(`${name}.confirm`), () => done(answerOf(true)), { class: "button quiet" }),
        button(t(`${name}.go_on`), () => done(answerOf(false))),
      ),
    );
}

/**
 * Render the page of a session that ended early, with the texts of its stage.
 * @param {Context} context
 * @param {import("./messages.js").SessionEnd} ending
 * @returns {(page: HTMLElement) => void}
 */
export function endedPage({ texts, study, state, another, address }, { completion }) {
  const { t } = bound(texts);
  const shown = completion.code || completion.url;
  const declined = state.stage === "declined"; // nothing was stored
  const takePart = () => window.location.replace(address);
  const changed = () => {
    const control = button(t("ended.take_back"), takePart, { class: "button quiet" });
    return el("p", { class: "apart" }, t("ended.mind_changed"), " ", control);
  };
  const reference = t("common.reference", { reference: state.reference });
  return (page) => {
    page.append(
      el("h1", {}, t(`${state.stage}.title`)),
      ...paragraphs(t(`${state.stage}.text`, study)),
      ...(shown ? [] : [el("p", {}, t("ended.return_submission"))]),
      ...completionParts(completion, t, "ended.go_hint"),
      declined ? changed() : el("p", { class: "small" }, reference),
    );
    if (!another) return;
    const next = button(t("common.another_person"), another, { class: "button quiet" });
    page.append(el("div", { class: "buttons" }, next));
  };
}

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
