/**
 * The last page: how well it went, and how to get the credit.
 * @module result_page
 */

import { button, el } from "./dom.js";
import { bound } from "./pages.js";

/** Hosts of the marketplace and of its place to try things. */
const MTURK = ["www.mturk.com", "workersandbox.mturk.com"];

/**
 * @param {import("./pages.js").Context} context
 * @param {any} result `Result`
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
      const share = number(texts, percentile);
      page.append(el("p", {}, t("result.percentile", { percentile: share })));
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

const number = (texts, value) =>
  new Intl.NumberFormat(texts.language, { maximumFractionDigits: 0 }).format(value);

function codeBox(code, t) {
  const shown = el("output", { class: "code", id: "code", tabindex: "0" }, code);
  const told = el("span", { role: "status", class: "small" });
  const copy = button(t("result.copy"), async () => {
    told.textContent = t((await copied(code, shown)) ? "result.copied" : "result.copy_failed");
  });
  copy.classList.add("quiet");
  const label = el("label", { for: "code" }, t("result.code"));
  return el("div", { class: "code-box" }, label, shown, copy, told);
}

/** The clipboard is missing outside https; selecting is then the next best. */
async function copied(code, shown) {
  try {
    await navigator.clipboard.writeText(code);
    return true;
  } catch {
    window.getSelection().selectAllChildren(shown);
    return document.execCommand("copy");
  }
}

/** A link, or a form where MTurk takes one. Only web addresses are ever followed. */
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
  // In the frame in which MTurk shows us, as the form in its documentation of ExternalQuestion.
  return el(
    "form",
    { method: "post", action: url },
    ...fields,
    el("div", { class: "buttons" }, send),
  );
}

function isMTurk(url) {
  const { protocol, host, pathname } = new URL(url);
  return protocol === "https:" && MTURK.includes(host) && pathname === "/mturk/externalSubmit";
}
