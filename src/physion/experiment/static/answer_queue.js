/**
 * Answers on their way to the server: each is kept by the browser before it is sent, sent in order,
 * one at a time, and forgotten only when the server has stored or refused it.
 * @module answer_queue
 */

import { Refused } from "./api.js";
import { keep, recall } from "./storage.js";

const NAME = "answers";

/** A key that no other answer has. `crypto.randomUUID` is missing outside https. */
export function newKey() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

export class AnswerQueue {
  #items = [];
  #working = null;
  #stop = new AbortController();

  /**
   * @param {import("./api.js").Api} api
   * @param {(refused: Refused) => void} onRefused Told of each answer that the server refused.
   */
  constructor(api, onRefused) {
    this.api = api;
    this.onRefused = onRefused;
  }

  /** So many answers are not stored yet. @returns {number} */
  get length() {
    return this.#items.length;
  }

  /** Take over what an earlier load of the page, or a crash, left behind. */
  load() {
    const known = new Set(this.#items.map((item) => item.answer.key));
    const left = (recall(NAME) ?? []).filter((item) => item?.answer && !known.has(item.answer.key));
    this.#items.unshift(...left);
    this.#work();
  }

  /**
   * Keep an answer and send it. The promise is kept when the server has stored it, and broken when
   * it refuses.
   * @param {Object} answer An `Answer` with its key.
   * @returns {Promise<any>} `AnswerStored`.
   */
  add(answer) {
    const stored = new Promise((resolve, reject) => {
      const item = { token: this.api.token, answer };
      keep(NAME, [...(recall(NAME) ?? []), item]);
      this.#items.push({ ...item, resolve, reject });
    });
    // Who does not wait for this answer hears of a refusal by onRefused.
    stored.catch(() => {});
    this.#work();
    return stored;
  }

  /** Resolves when nothing is left to send. @returns {Promise<void>} */
  async empty() {
    while (this.#items.length > 0 && !this.#stop.signal.aborted) await this.#work();
  }

  /** Send nothing more: another tab has taken over, which finds the rest in the storage. */
  close() {
    this.#stop.abort(new DOMException("the queue is closed", "AbortError"));
  }

  #work() {
    this.#working ??= this.#sendAll().finally(() => (this.#working = null));
    return this.#working;
  }

  async #sendAll() {
    while (this.#items.length > 0 && !this.#stop.signal.aborted) {
      const item = this.#items[0];
      try {
        const options = { token: item.token, signal: this.#stop.signal };
        const stored = await this.api.post("/api/answers", item.answer, options);
        this.#forget(item);
        item.resolve?.(stored);
      } catch (error) {
        if (!(error instanceof Refused)) return; // closed
        this.#forget(item);
        item.reject?.(error);
        this.onRefused(error);
      }
    }
  }

  #forget(item) {
    this.#items.shift();
    const key = item.answer.key;
    const rest = (recall(NAME) ?? []).filter((other) => other?.answer?.key !== key);
    keep(NAME, rest.length > 0 ? rest : null);
  }
}
