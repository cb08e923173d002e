/**
 * Full screen during the trials, if the study wants it.
 * @module fullscreen
 */

import { button, el, paragraphs } from "./dom.js";
import { bound } from "./texts.js";

/** Whether the participant continues without full screen, so that it is not offered again. */
let without = false;

/**
 * Return whether full screen must be offered before the next trial.
 * @param {import("./messages.js").PublicStudy} study
 * @returns {boolean}
 */
export function offersFullscreen(study) {
  const can = document.fullscreenEnabled && !document.fullscreenElement;
  return study.fullscreen && can && !without;
}

/**
 * Render the page that switches to full screen; browsers demand a press of a button for it. Who
 * cannot or does not want to continues without.
 * @param {import("./pages.js").Context} context
 * @returns {import("./pages.js").Render}
 */
export function fullscreenPage({ texts, log }) {
  const { t } = bound(texts);
  return (page, done) => {
    const goOn = (reason) => {
      without = true;
      log.add("no_fullscreen", { reason });
      done();
    };
    const request = () =>
      document.documentElement.requestFullscreen().then(done, (error) => goOn(String(error)));
    page.append(
      el("h1", {}, t("fullscreen.title")),
      ...paragraphs(t("fullscreen.text")),
      el(
        "div",
        { class: "buttons" },
        button(t("fullscreen.without"), () => goOn("declined"), { class: "button quiet" }),
        button(t("fullscreen.go"), request),
      ),
    );
  };
}

/** Leave full screen, after the trials. */
export function leaveFullscreen() {
  if (document.fullscreenElement) document.exitFullscreen().catch(() => {});
}
