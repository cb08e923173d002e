/**
 * Requests to the server, with retries. Failed requests (no connection, timeout, 5xx, 429, or a
 * response of a proxy, a firewall or a captive portal) are repeated with growing pauses until the
 * server answers; refusals are thrown as `Refused`.
 * All requests are idempotent: answers have keys, and pages can be sent twice.
 * @module api
 */

/** Longest time without any data; a slow but steady response is not given up. */
const STALLED_MS = 15_000;
const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 8_000;
/** Codes of final refusals. Any other response with a 4xx status is not from our server. */
const CODES = new Set([
  "bad_request",
  "too_large",
  "unknown_token",
  "bad_link",
  "id_needed",
  "id_refused",
  "other_browser",
  "already_took_part",
  "study_full",
  "held",
  "paused",
  "wrong_stage",
  "out_of_order",
  "already_answered",
  "not_shown",
  "not_yet",
  "not_found",
  "not_allowed",
]);
/** An answer for whose acceptance the server still waits; nothing is wrong with the connection. */
const TOO_EARLY = 425;
/** Statuses that are worth a retry although they are 4xx. */
const TEMPORARY = [408, TOO_EARLY, 429];

/** Refusal by the server; `state` is the state of the session if the server sent it. */
export class Refused extends Error {
  /** @param {number} status @param {import("./messages.js").Refusal} body */
  constructor(status, body) {
    super(body.message ?? `status ${status}`);
    this.status = status;
    this.code = body.error;
    this.state = body.state ?? null;
    /** How a participant who is refused reports back to the recruiter. */
    this.completion = body.completion ?? null;
  }
}

/** Temporary failure of a request, after which it is retried. */
class Trouble extends Error {
  /**
   * @param {string} message
   * @param {number} [pauseMs] Pause requested by the server.
   * @param {number} [status] Status of the response, 0 without one.
   */
  constructor(message, pauseMs = 0, status = 0) {
    super(message);
    this.pauseMs = pauseMs;
    /** Too many requests; the page for entering then shows the time of the next attempt. */
    this.crowd = status === 429;
    this.busy = this.crowd || status >= 500;
    this.silent = status === TOO_EARLY;
  }
}

/**
 * Wait for some time, or until the browser is online again.
 * @param {number} ms @param {AbortSignal} [signal] @returns {Promise<void>}
 */
function pause(ms, signal) {
  return new Promise((resolve, reject) => {
    const end = () => {
      clearTimeout(timer);
      window.removeEventListener("online", end);
      signal?.removeEventListener("abort", end);
      if (signal?.aborted) reject(signal.reason);
      else resolve();
    };
    const timer = setTimeout(end, ms);
    window.addEventListener("online", end);
    signal?.addEventListener("abort", end);
  });
}

/**
 * @typedef {Object} Options
 * @property {string|null} [token] Token to send; by default the token of the current session.
 * @property {AbortSignal} [signal]
 * @property {string} [expects] Field that the response must have to be accepted as our server's.
 * @property {(ms: number) => void} [onBusy] Called when there are too many requests, with the time
 *   until the next attempt; without it they are reported by `onTrouble`.
 */

/** Client of the server's API. */
export class Api {
  /**
   * @param {(trouble: "lost"|"busy"|null) => void} onTrouble Called when requests begin to fail,
   *   fail in the other way, or no longer fail (null).
   */
  constructor(onTrouble) {
    this.onTrouble = onTrouble;
    /** @type {string|null} */
    this.token = null;
    /** Kind of failure of each failing request. @type {Map<symbol, "lost"|"busy">} */
    this.failing = new Map();
    /** @type {"lost"|"busy"|null} */
    this.trouble = null;
  }

  /**
   * Send a GET request and return the JSON body.
   * @param {string} path @param {Options} [options] @returns {Promise<any>}
   */
  get(path, options = {}) {
    return this.#repeat(() => this.#json("GET", path, undefined, options), options.signal);
  }

  /**
   * Send a POST request and return the JSON body.
   * @param {string} path @param {any} body A function is called for each attempt.
   * @param {Options} [options] @returns {Promise<any>}
   */
  post(path, body, options = {}) {
    const { signal, onBusy } = options;
    const current = () => (typeof body === "function" ? body() : body);
    return this.#repeat(() => this.#json("POST", path, current(), options), signal, onBusy);
  }

  /**
   * Fetch a movie or an image.
   * @param {string} path @param {AbortSignal} [signal] @returns {Promise<Blob>}
   */
  blob(path, signal) {
    return this.#repeat(async () => {
      const response = await this.#fetch(path, {}, signal);
      const type = response.headers.get("Content-Type") ?? "";
      if (!/^(video|image)\//.test(type)) throw new Trouble(`neither movie nor image: ${type}`);
      return response.blob();
    }, signal);
  }

  /**
   * Send a POST request once, without retries, even while the page is being closed.
   * @param {string} path @param {any} body
   */
  async tell(path, body) {
    const init = { ...this.#init("POST", body, this.token), keepalive: true };
    await this.#fetch(path, init);
  }

  /**
   * Send a request once and return the JSON body.
   * @param {string} method @param {string} path @param {any} body @param {Options} options
   * @returns {Promise<any>}
   */
  async #json(method, path, body, { token = this.token, signal, expects }) {
    const response = await this.#fetch(path, this.#init(method, body, token), signal);
    const answer = await response.json().catch(() => null);
    const ours = answer && typeof answer === "object" && (!expects || expects in answer);
    if (!ours) throw new Trouble(`status ${response.status}, but not a response of our server`);
    return answer;
  }

  /**
   * @param {string} method @param {any} body @param {string|null} token
   * @returns {RequestInit}
   */
  #init(method, body, token) {
    /** @type {Record<string, string>} */
    const headers = { Accept: "application/json" };
    if (token) headers.Authorization = `Bearer ${token}`;
    if (body !== undefined) headers["Content-Type"] = "application/json";
    return { method, headers, body: body === undefined ? undefined : JSON.stringify(body) };
  }

  /**
   * Fetch a complete response; an interrupted one counts as failed.
   * @param {string} path @param {RequestInit} init @param {AbortSignal} [signal]
   * @returns {Promise<Response>}
   */
  async #fetch(path, init, signal) {
    const timeout = new AbortController();
    let timer = 0;
    const arrived = () => {
      clearTimeout(timer);
      timer = setTimeout(() => timeout.abort(), STALLED_MS);
    };
    arrived();
    const stop = () => timeout.abort();
    signal?.addEventListener("abort", stop);
    try {
      const response = await fetch(path, { credentials: "omit", signal: timeout.signal, ...init });
      const whole = new Response(await bodyOf(response, arrived), response);
      if (response.ok) return whole;
      const { status } = response;
      const body = await whole.json().catch(() => null);
      if (status < 500 && !TEMPORARY.includes(status) && CODES.has(body?.error)) {
        throw new Refused(status, body);
      }
      const seconds = Number(response.headers.get("Retry-After")) || 0;
      const pauseMs = Math.min(Math.max(seconds, 0), 60) * 1000;
      throw new Trouble(`status ${status}`, pauseMs, status);
    } catch (error) {
      if (signal?.aborted) throw signal.reason;
      if (error instanceof Refused || error instanceof Trouble) throw error;
      throw new Trouble(String(error));
    } finally {
      clearTimeout(timer);
      signal?.removeEventListener("abort", stop);
    }
  }

  /**
   * Repeat a request until it succeeds or is refused.
   * @template T
   * @param {() => Promise<T>} attempt
   * @param {AbortSignal} [signal]
   * @param {((ms: number) => void)|null} [onBusy]
   * @returns {Promise<T>}
   */
  async #repeat(attempt, signal, onBusy = null) {
    let wait = FIRST_PAUSE_MS;
    const request = Symbol("request");
    try {
      for (;;) {
        try {
          return await attempt();
        } catch (error) {
          if (!(error instanceof Trouble)) throw error;
          const crowd = error.crowd && onBusy;
          if (!crowd && !error.silent) this.#troubled(request, error.busy ? "busy" : "lost");
          // Random pauses, so that many participants do not retry at the same moment.
          const ms = Math.max(error.pauseMs, wait / 2) + (Math.random() * wait) / 2;
          if (crowd) onBusy(ms);
          await pause(ms, signal);
          wait = Math.min(wait * 2, LONGEST_PAUSE_MS);
        }
      }
    } finally {
      this.#troubled(request, null);
    }
  }

  /** Note how a request fails, null if not, and report a change. */
  #troubled(request, how) {
    if (how) this.failing.set(request, how);
    else this.failing.delete(request);
    const all = [...this.failing.values()];
    const trouble = all.includes("lost") ? "lost" : (all[0] ?? null);
    if (trouble !== this.trouble) this.onTrouble(trouble);
    this.trouble = trouble;
  }
}

/**
 * Read the body of a response.
 * @param {Response} response
 * @param {() => void} arrived Called for each chunk that arrives.
 * @returns {Promise<Blob>}
 */
async function bodyOf(response, arrived) {
  const chunks = [];
  const reader = response.body?.getReader();
  while (reader) {
    const { done, value } = await reader.read();
    if (done) break;
    arrived();
    chunks.push(value);
  }
  return new Blob(chunks, { type: response.headers.get("Content-Type") ?? "" });
}
