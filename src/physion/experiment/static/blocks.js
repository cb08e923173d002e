/**
 * The blocks of a session: one, or one for each of several scenarios.
 * @module blocks
 */

import { button, el, paragraphs } from "./dom.js";
import { bound } from "./texts.js";

/** @typedef {import("./messages.js").SessionState} SessionState */

/** Return the current block. @param {SessionState} state */
export const currentBlock = (state) => state.blocks[state.block];

/** Return whether a session has several blocks. @param {SessionState} state */
export const hasBlocks = (state) => state.blocks.length > 1;

/**
 * Return the number of trials of a block in a phase.
 * @param {import("./messages.js").BlockTrials} block
 * @param {import("./messages.js").Phase} phase
 */
export const size = (block, phase) => block[phase][1] - block[phase][0];

/**
 * Return how many trials of both phases come before a trial in the session, and how many there are.
 * @param {SessionState} state
 * @param {import("./messages.js").Phase} phase
 * @param {number} trial
 */
export function sessionProgress(state, phase, trial) {
  const { familiarization, test } = currentBlock(state);
  const other = phase === "test" ? familiarization[1] : test[0];
  return { before: trial + other, all: state.trials.familiarization + state.trials.test };
}

/**
 * Render the page between two blocks; ends when the participant continues.
 * @param {import("./pages.js").Context} context
 * @returns {import("./pages.js").Render}
 */
export function blockPage({ texts, state }) {
  const { t } = bound(texts);
  const next = state.blocks[state.block + 1];
  const prompt = texts.inScenario(next.scenario).t("trial.prompt");
  const [practice, trials] = [size(next, "familiarization"), size(next, "test")];
  const number = { block: state.block + 2, blocks: state.blocks.length };
  const rest = { answered: currentBlock(state).test[1], trials: state.trials.test };
  const follows = practice > 0 ? "block.practice" : "block.no_practice";
  return (page, done) =>
    page.append(
      el("h1", {}, t("block.title", number)),
      ...paragraphs(t("block.text", rest)),
      ...paragraphs(t(follows, { practice, trials })),
      ...(prompt === t("trial.prompt") ? [] : paragraphs(t("block.question", { prompt }))),
      el("div", { class: "buttons" }, button(t("block.go_on"), () => done())),
    );
}
