/**
 * The control by which a preview goes to any page or trial.
 * @module jump
 */

import { el } from "./dom.js";
import { bound } from "./texts.js";

/**
 * Create the control for the places that the server names.
 * @param {import("./texts.js").Texts} texts
 * @param {import("./messages.js").SessionState} state
 * @param {(to: {stage: string, trial: number}) => void} onJump
 * @returns {HTMLElement}
 */
export function jumpControl(texts, state, onJump) {
  const { t } = bound(texts);
  const blocks = state.blocks.length;
  // A page that each block has is chosen by the number of the block.
  const numbers = { ...state.trials, ready: blocks, block: blocks - 1 };
  const options = state.places.map((stage) =>
    el("option", { value: stage, selected: stage === state.stage }, t(`preview.${stage}`)),
  );
  const stages = el("select", { id: "jump-stage", "aria-label": t("preview.page") }, ...options);
  const number = el("input", {
    id: "jump-trial",
    type: "number",
    min: 1,
    value: 1,
    "aria-label": t("preview.trial"),
  });
  const choose = () => {
    const most = numbers[stages.value];
    const single = stages.value === "ready" && blocks === 1;
    number.hidden = most === undefined || single;
    number.max = String(most ?? 1);
  };
  stages.addEventListener("change", choose);
  choose();
  const go = el("button", { class: "link" }, t("preview.go"));
  const form = el("form", { class: "jump" }, stages, number, go);
  form.addEventListener("submit", (event) => {
    event.preventDefault();
    onJump({ stage: stages.value, trial: number.hidden ? 0 : Number(number.value) - 1 });
  });
  return form;
}
