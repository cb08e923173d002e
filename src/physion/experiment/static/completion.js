/**
 * How participants report back to the recruiter: a completion code, a link or a form.
 * @module completion
 */

import { button, el } from "./dom.js";

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
