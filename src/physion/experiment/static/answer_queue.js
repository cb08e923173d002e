/**
 * Answers on their way to the server: each is kept by the browser before it is sent, sent in order,
 * one at a time, and forgotten only when the server has stored it, or has refused it for good and
 * stored an event that holds it. Answers whose token the server does not know wait for another
 * token of their session.
 * @module answer_queue
 */

import { Refused } from "./api.js";
import { keep, recall } from "./storage.js";

const NAME = "answers";
const DAY_MS = 86_400_000;
/** Refusals that no other try and no other token will change. */
const FINAL = ["already_answered", "out_of_order", "wrong_stage", "bad_request", "too_large"];

/** @typedef {{token: string, session: string|null, answer: any}} Item `session`: its reference. */

export class AnswerQueue {
  #items = [];
  #working = null;
  #stop = new AbortController();
  /** Tokens with which nothing can be sent. */
  #useless = new Set();
  #session = null;

  /**
   * @param {import("./api.js").Api} api
   * @param {(refused: Refused) => void} onRefused Told of each answer that the server refused, for
   *   good or (`unknown_token`) until its session is entered again.
   */
  constructor(api, onRefused) {
    this.api = api;
    this.onRefused = onRefused;
  }

  /** So many answers are on their way. @returns {number} */
  get length() {
    return this.#items.filter((item) => this.#canGo(item)).length;
  }

  /** Take over what an earlier load of the page, or a crash, left behind. */
  load() {
    const known = new Set(this.#items.map((item) => item.answer.key));
    const left = (recall(NAME) ?? []).filter((item) => item?.answer && !known.has(item.answer.key));
    this.#items.unshift(...left);
    this.#work();
  }

  /**
   * A session was entered: answers are added to it from now on, and those of it that wait for a
   * token that works get this one.
   * @param {string} token @param {string} session Its reference. @returns {boolean} Are there any?
   */
  enter(token, session) {
    this.#session = session;
    const waiting = this.#items.filter((item) => !this.#canGo(item) && item.session === session);
    if (waiting.length === 0) return false;
    for (const item of waiting) item.token = token;
    const keys = new Set(waiting.map((item) => item.answer.key));
    const kept = recall(NAME) ?? [];
    keep(
      NAME,
      kept.map((item) => (keys.has(item?.answer?.key) ? { ...item, token } : item)),
    );
    this.#work();
    return true;
  }

  /** Do answers wait for another token than this one? @param {string} token @returns {boolean} */
  waits(token) {
    return this.#items.some((item) => item.token === token && !this.#canGo(item));
  }

  /**
   * Keep an answer and send it. The promise is kept when the server has stored it, and broken when
   * it refuses.
   * @param {Object} answer An `Answer` with its key.
   * @returns {Promise<any>} `AnswerStored`.
   */
  add(answer) {
    const stored = new Promise((resolve, reject) => {
      const item = { token: this.api.token, session: this.#session, answer };
      keep(NAME, [...(recall(NAME) ?? []), item]);
      this.#items.push({ ...item, resolve, reject });
    });
    // Who does not wait for this answer hears of a refusal by onRefused.
    stored.catch(() => {});
    this.#work();
    return stored;
  }

  /** Resolves when nothing is left that can be sent. @returns {Promise<void>} */
  async empty() {
    while (this.length > 0 && !this.#stop.signal.aborted) await this.#work();
  }

  /** Send nothing more: another tab has taken over, which finds the rest in the storage. */
  close() {
    this.#stop.abort(new DOMException("the queue is closed", "AbortError"));
  }

  #canGo(item) {
    return !this.#useless.has(item.token);
  }

  #work() {
    this.#working ??= this.#sendAll().finally(() => (this.#working = null));
    return this.#working;
  }

  async #sendAll() {
    const { signal } = this.#stop;
    while (!signal.aborted) {
      const item = this.#items.find((one) => this.#canGo(one));
      if (!item) return;
      try {
        const options = { token: item.token, signal, expects: "duplicate" };
        const stored = await this.api.post("/api/answers", item.answer, options);
        this.#forget(item);
        item.resolve?.(stored);
      } catch (error) {
        if (!(error instanceof Refused)) return; // closed
        await this.#refused(item, error);
      }
    }
  }

  async #refused(item, error) {
    if (!FINAL.includes(error.code)) this.#useless.add(item.token);
    else if (await this.#noted(item, error)) this.#forget(item);
    else return;
    item.reject?.(error);
    this.onRefused(error);
  }

  /** Has the server stored what was refused, so that no answer is lost without a trace? */
  async #noted({ token, answer }, error) {
    const { key, phase, trial, response, rt_ms } = answer;
    const data = { code: error.code, phase, trial, response, rt_ms };
    const at_ms = Math.min(Math.round(performance.now()), DAY_MS);
    const events = { key, events: [{ kind: "answer_refused", at_ms, data }] };
    try {
      await this.api.post("/api/events", events, { token, signal: this.#stop.signal });
    } catch (trouble) {
      if (!(trouble instanceof Refused)) return false; // closed: the next load tries again
    }
    return true;
  }

  #forget(item) {
    this.#items = this.#items.filter((other) => other !== item);
    const { key } = item.answer;
    const rest = (recall(NAME) ?? []).filter((other) => other?.answer?.key !== key);
    keep(NAME, rest.length > 0 ? rest : null);
  }
}
