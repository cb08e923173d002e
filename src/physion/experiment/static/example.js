/**
 * The animated example of the instructions: the flashing cue and the observed movie in a loop.
 * @module example
 */

import { button, el, sleep } from "./dom.js";
import { Screen } from "./screen.js";

const REST_MS = 1_000;

/**
 * Create an element that shows the example of the session's scenario until the signal aborts. It
 * can be paused, and does not start by itself if the user prefers reduced motion.
 * @param {import("./pages.js").Context} context
 * @param {AbortSignal} signal
 * @returns {HTMLElement}
 */
export function showExample(context, signal) {
  const { study, state, texts, log } = context;
  const media = study.example[state.scenario];
  const box = el("div", { class: "example" });
  if (!media) return box;
  const container = el("div", { class: "example-place" });
  /** @type {AbortController|null} */
  let run = null;
  const toggle = button("", () => (run ? pause() : play()), { class: "button quiet small" });
  box.append(container, toggle);
  const label = () => {
    toggle.textContent = texts.t(run ? "instructions.example_pause" : "instructions.example_play");
  };
  const pause = () => {
    run?.abort(new DOMException("paused", "AbortError"));
    run = null;
    label();
  };
  const play = () => {
    const own = new AbortController();
    run = own;
    label();
    loop(context, media, container, own.signal).catch((error) => {
      if (own.signal.aborted) return;
      log.add("example_failed", { message: String(error) });
      box.replaceChildren(el("p", { role: "alert" }, texts.t("instructions.example_failed")));
    });
  };
  signal.addEventListener("abort", pause);
  const still = window.matchMedia("(prefers-reduced-motion: reduce)").matches;
  if (still) pause();
  else play();
  return box;
}

/**
 * Show cue and movie in a loop.
 * @param {import("./pages.js").Context} context
 * @param {import("./messages.js").TrialMedia} media
 * @param {HTMLElement} container
 * @param {AbortSignal} signal
 */
async function loop({ api, study }, media, container, signal) {
  const blobs = await Promise.all([media.movie, media.map].map((path) => api.blob(path, signal)));
  const [movie, map] = blobs.map((blob) => URL.createObjectURL(blob));
  try {
    for (;;) {
      const screen = new Screen(media, signal);
      container.replaceChildren(screen.element);
      try {
        await screen.load({ movie, map });
        await screen.flash({ ms: study.cue_ms, hz: study.flash_hz });
        await screen.play({ hide: true });
      } finally {
        screen.release();
      }
      await sleep(REST_MS);
      signal.throwIfAborted();
    }
  } finally {
    URL.revokeObjectURL(movie);
    URL.revokeObjectURL(map);
  }
}
