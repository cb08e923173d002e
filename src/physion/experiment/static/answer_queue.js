/**
 * Queue of answers to send. Each answer is saved in the browser's storage before it is sent.
 * Answers are sent in order, one at a time, and removed only when the server has stored them, or
 * has refused them for good and stored an event with their data. Answers whose token the server
 * does not know wait for another token of their session.
 * @module answer_queue
 */

import { Refused } from "./api.js";
import { keep, newKey, recall } from "./storage.js";

const DAY_MS = 86_400_000;

/**
 * A showing. `began`: when it began (see `present`); `stored`: whether the server has acknowledged
 * it.
 * @typedef {{key: string, phase: string, trial: number, began: number, stored: boolean}} Announced
 */

/**
 * Return the time in ms since 1970. Within a page it only grows, even if the machine's clock is
 * set; `performance.now` starts at 0 again after a reload, which stored showings outlive.
 * @returns {number}
 */
function present() {
  return performance.timeOrigin + performance.now();
}

/**
 * Return the showing that begins now.
 * @param {string} phase @param {number} trial
 * @returns {Announced}
 */
export function newShowing(phase, trial) {
  return { key: newKey(), phase, trial, began: present(), stored: false };
}

/**
 * Send a showing until the server has it; it is counted once. Returns also if it was refused, since
 * the answer is then refused too.
 * @param {import("./api.js").Api} api
 * @param {Announced} showing
 * @param {import("./api.js").Options} [options]
 */
export async function announce(api, showing, options = {}) {
  if (showing.stored) return;
  const { key, phase, trial, began } = showing;
  const ago = () => Math.min(Math.max(present() - began, 0), DAY_MS);
  const body = () => ({ key, phase, trial, ago_ms: ago() });
  try {
    await api.post("/api/showings", body, { ...options, expects: "showings" });
    showing.stored = true;
  } catch (error) {
    if (!(error instanceof Refused)) throw error;
  }
}

const NAME = "answers";
/** Refusals that neither a retry nor another token can change. */
const FINAL = [
  "already_answered",
  "out_of_order",
  "wrong_stage",
  "not_shown",
  "bad_request",
  "too_large",
];

/** @typedef {import("./messages.js").Answer} Answer */
/** @typedef {import("./messages.js").AnswerStored} AnswerStored */

/**
 * An answer with the last showing of its trial, the token and the reference of its session;
 * `resolve` and `reject` settle the promise of `add` and are missing after a reload of the page.
 * @typedef {{token: string, session: string|null, answer: Answer, showing: Announced|null,
 *   resolve?: (stored: AnswerStored) => void, reject?: (error: Error) => void}} Item
 */

/** First-in, first-out queue of answers, persistent over reloads of the page. */
export class AnswerQueue {
  /** @type {Item[]} */
  #items = [];
  /** The running loop of `#sendAll`. @type {Promise<void>|null} */
  #working = null;
  #stop = new AbortController();
  /** Tokens that the server does not know. @type {Set<string>} */
  #invalidTokens = new Set();
  /** Reference of the current session. @type {string|null} */
  #session = null;

  /**
   * @param {import("./api.js").Api} api
   * @param {(refused: Refused) => void} onRefused Called for each answer that the server refused,
   *   for good or (`unknown_token`) until its session is entered again.
   */
  constructor(api, onRefused) {
    this.api = api;
    this.onRefused = onRefused;
  }

  /** Number of answers that can be sent. @returns {number} */
  get length() {
    return this.#items.filter((item) => this.#isSendable(item)).length;
  }

  /** Add the answers that an earlier load of the page left in the storage. */
  load() {
    const known = new Set(this.#items.map((item) => item.answer.key));
    const left = (recall(NAME) ?? []).filter((item) => item?.answer && !known.has(item.answer.key));
    this.#items.unshift(...left);
    this.#work();
  }

  /**
   * Set the session of the following answers, and give its token to its waiting answers.
   * @param {string} token
   * @param {string} session Reference of the session.
   * @returns {boolean} Whether there were such answers.
   */
  enter(token, session) {
    this.#session = session;
    const waiting = this.#items.filter(
      (item) => !this.#isSendable(item) && item.session === session,
    );
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

  /**
   * Return whether answers with this token wait for another token.
   * @param {string} token
   * @returns {boolean}
   */
  waits(token) {
    return this.#items.some((item) => item.token === token && !this.#isSendable(item));
  }

  /**
   * Save an answer in the storage and send it. The promise resolves when the server has stored the
   * answer, and rejects when it refuses it.
   * @param {Answer} answer
   * @param {Announced|null} showing The last showing of the trial.
   * @returns {Promise<AnswerStored>}
   */
  add(answer, showing = null) {
    const stored = new Promise((resolve, reject) => {
      const item = { token: this.api.token, session: this.#session, answer, showing };
      keep(NAME, [...(recall(NAME) ?? []), item]);
      this.#items.push({ ...item, resolve, reject });
    });
    // Callers that do not await this answer learn of a refusal by onRefused.
    stored.catch(() => {});
    this.#work();
    return stored;
  }

  /** Wait until no answer is left that can be sent. @returns {Promise<void>} */
  async empty() {
    while (this.length > 0 && !this.#stop.signal.aborted) await this.#work();
  }

  /** Stop sending: another tab has taken over, and finds the remaining answers in the storage. */
  close() {
    this.#stop.abort(new DOMException("the queue is closed", "AbortError"));
  }

  /** @param {Item} item @returns {boolean} */
  #isSendable(item) {
    return !this.#invalidTokens.has(item.token);
  }

  #work() {
    this.#working ??= this.#sendAll().finally(() => (this.#working = null));
    return this.#working;
  }

  async #sendAll() {
    const { signal } = this.#stop;
    while (!signal.aborted) {
      const item = this.#items.find((each) => this.#isSendable(each));
      if (!item) return;
      try {
        if (item.showing) await announce(this.api, item.showing, { token: item.token, signal });
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

  /** @param {Item} item @param {Refused} error */
  async #refused(item, error) {
    if (!FINAL.includes(error.code)) this.#invalidTokens.add(item.token);
    else if (await this.#storeRefusal(item, error)) this.#forget(item);
    else return;
    item.reject?.(error);
    this.onRefused(error);
  }

  /**
   * Send a refused answer as an event, so that it is not lost without a trace.
   * @param {Item} item
   * @param {Refused} error
   * @returns {Promise<boolean>} False if the queue was closed before.
   */
  async #storeRefusal({ token, answer }, error) {
    const { key, phase, trial, response, rt_ms } = answer;
    const data = { code: error.code, phase, trial, response, rt_ms };
    const at_ms = Math.min(Math.round(performance.now()), DAY_MS);
    const events = { key, events: [{ kind: "answer_refused", at_ms, data }] };
    try {
      await this.api.post("/api/events", events, { token, signal: this.#stop.signal });
    } catch (trouble) {
      if (!(trouble instanceof Refused)) return false; // closed: the next page load tries again
    }
    return true;
  }

  /** Remove an answer from the queue and the storage. @param {Item} item */
  #forget(item) {
    this.#items = this.#items.filter((other) => other !== item);
    const { key } = item.answer;
    const rest = (recall(NAME) ?? []).filter((other) => other?.answer?.key !== key);
    keep(NAME, rest.length > 0 ? rest : null);
  }
}
