/**
 * Requests to the server. What fails on the way (no connection, timeout, 5xx, 429, or an answer of
 * somebody else: a proxy, a firewall, a hotel's login page) is tried again, with growing pauses,
 * until our server answers; what it refuses is thrown as `Refused`.
 * Every request may be repeated safely: answers have keys, pages can be sent twice.
 * @module api
 */

/** So long nothing may arrive; a slow connection is none the worse for being slow. */
const STALLED_MS = 15_000;
const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 8_000;
/** Words for refusals that stay. What else comes with a status of 4xx is not from our server. */
const CODES = new Set([
  "bad_request",
  "too_large",
  "unknown_token",
  "bad_link",
  "id_needed",
  "already_took_part",
  "study_full",
  "wrong_stage",
  "out_of_order",
  "already_answered",
  "not_yet",
  "not_found",
  "not_allowed",
]);
const PASSING = [408, 429];

/** The server said no. `state`: where the session stands, where the server told it. */
export class Refused extends Error {
  /** @param {number} status @param {any} body A `Refusal`. */
  constructor(status, body) {
    super(body.message ?? `status ${status}`);
    this.status = status;
    this.code = body.error;
    this.state = body.state ?? null;
  }
}

/** A failure that may pass: the request is tried again. */
class Trouble extends Error {
  /**
   * @param {string} message
   * @param {number} [pauseMs] What the server asks to wait.
   * @param {number} [status] Of the answer, where there was one.
   */
  constructor(message, pauseMs = 0, status = 0) {
    super(message);
    this.pauseMs = pauseMs;
    /** Too many requests: who enters is told when it is tried again. */
    this.crowd = status === 429;
    this.busy = this.crowd || status >= 500;
  }
}

/**
 * Waits, but not longer than until the browser is online again.
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
 * @property {string|null} [token] Of whom, where it is not the one who entered here.
 * @property {AbortSignal} [signal]
 * @property {string} [expects] A name that the answer must have, else it is not our server's.
 * @property {(ms: number) => void} [onBusy] Told that there are too many requests, and when it is
 *   tried again; without it that counts as lost connection.
 */

export class Api {
  /**
   * @param {(trouble: "lost"|"busy"|null) => void} onTrouble Called as requests begin to fail, fail
   *   in the other way, or cease to fail.
   */
  constructor(onTrouble) {
    this.onTrouble = onTrouble;
    /** @type {string|null} */
    this.token = null;
    /** How each request fails that fails now. @type {Map<symbol, "lost"|"busy">} */
    this.failing = new Map();
    this.trouble = null;
  }

  /** @param {string} path @param {Options} [options] @returns {Promise<any>} */
  get(path, options = {}) {
    return this.#repeat(() => this.#json("GET", path, undefined, options), options.signal);
  }

  /** @param {string} path @param {any} body @param {Options} [options] @returns {Promise<any>} */
  post(path, body, options = {}) {
    const { signal, onBusy } = options;
    return this.#repeat(() => this.#json("POST", path, body, options), signal, onBusy);
  }

  /** @param {string} path @param {AbortSignal} [signal] @returns {Promise<Blob>} */
  blob(path, signal) {
    return this.#repeat(async () => {
      const response = await this.#fetch(path, {}, signal);
      const type = response.headers.get("Content-Type") ?? "";
      if (!/^(video|image)\//.test(type)) throw new Trouble(`neither movie nor picture: ${type}`);
      return response.blob();
    }, signal);
  }

  /** One try alone, that outlives the page. @param {string} path @param {any} body */
  async tell(path, body) {
    const init = { ...this.#init("POST", body, this.token), keepalive: true };
    await this.#fetch(path, init);
  }

  /** @param {string} method @param {string} path @param {any} body @param {Options} options */
  async #json(method, path, body, { token = this.token, signal, expects }) {
    const response = await this.#fetch(path, this.#init(method, body, token), signal);
    const answer = await response.json().catch(() => null);
    const ours = answer && typeof answer === "object" && (!expects || expects in answer);
    if (!ours) throw new Trouble(`status ${response.status}, but not our server's answer`);
    return answer;
  }

  #init(method, body, token) {
    const headers = { Accept: "application/json" };
    if (token) headers.Authorization = `Bearer ${token}`;
    if (body !== undefined) headers["Content-Type"] = "application/json";
    return { method, headers, body: body === undefined ? undefined : JSON.stringify(body) };
  }

  /** A whole answer, so that one that breaks off midway counts as failed. */
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
      const options = { credentials: "omit", signal: timeout.signal, ...init };
      const response = await fetch(path, options);
      const whole = new Response(await bodyOf(response, arrived), response);
      if (response.ok) return whole;
      const { status } = response;
      const body = await whole.json().catch(() => null);
      if (status < 500 && !PASSING.includes(status) && CODES.has(body?.error)) {
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
          if (!crowd) this.#troubled(request, error.busy ? "busy" : "lost");
          // Spread over time, so that a room of participants does not come back in one moment.
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

  #troubled(request, how) {
    if (how) this.failing.set(request, how);
    else this.failing.delete(request);
    const all = [...this.failing.values()];
    const trouble = all.includes("lost") ? "lost" : (all[0] ?? null);
    if (trouble !== this.trouble) this.onTrouble(trouble);
    this.trouble = trouble;
  }
}

/** What is in an answer; tells of each piece that arrives. @returns {Promise<Blob>} */
async function bodyOf(response, arrived) {
  const pieces = [];
  const reader = response.body?.getReader();
  while (reader) {
    const { done, value } = await reader.read();
    if (done) break;
    arrived();
    pieces.push(value);
  }
  return new Blob(pieces, { type: response.headers.get("Content-Type") ?? "" });
}
