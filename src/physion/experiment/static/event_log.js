/**
 * Log of other events in the browser (hidden, offline, errors, ...), sent in batches after consent.
 * Nothing waits for it; a lost event is not a loss of the study's data.
 * @module event_log
 */

import { newKey } from "./storage.js";

const DAY_MS = 86_400_000;
const BATCH = 50;
const MOST_KEPT = 500;
const EVERY_MS = 5_000;

/** Collects events and sends them every few seconds and when the page is left. */
export class EventLog {
  /** @type {import("./messages.js").Event[]} */
  #events = [];
  /** The batch that is sent next. @type {import("./messages.js").Events|null} */
  #batch = null;
  /** Sending that has begun and not ended. @type {Promise<void>|null} */
  #sending = null;
  #consented = false;

  /** @param {import("./api.js").Api} api */
  constructor(api) {
    this.api = api;
    setInterval(() => this.send(), EVERY_MS);
    window.addEventListener("pagehide", () => this.leave());
    document.addEventListener("visibilitychange", () => {
      this.add(document.hidden ? "hidden" : "visible");
      if (document.hidden) this.send();
    });
    window.addEventListener("online", () => {
      this.add("online");
      this.send();
    });
    document.addEventListener("fullscreenchange", () =>
      this.add("fullscreen", { on: document.fullscreenElement !== null }),
    );
    window.addEventListener("offline", () => this.add("offline"));
    window.addEventListener("error", (event) => this.add("error", { message: event.message }));
    window.addEventListener("unhandledrejection", (event) =>
      this.add("error", { message: String(event.reason) }),
    );
    /** @type {ReturnType<typeof setTimeout>|undefined} */
    let resizing;
    window.addEventListener("resize", () => {
      clearTimeout(resizing);
      const size = () => ({ width: window.innerWidth, height: window.innerHeight });
      resizing = setTimeout(() => this.add("resized", size()), 300);
    });
  }

  /**
   * Add an event.
   * @param {string} kind Lower-case letters and "_".
   * @param {Object<string, boolean|number|string|null>} [data]
   */
  add(kind, data = {}) {
    const short = Object.entries(data).map(([name, value]) => [
      name,
      typeof value === "string" ? value.slice(0, 1000) : value,
    ]);
    const at_ms = Math.min(Math.round(performance.now() * 10) / 10, DAY_MS);
    this.#events.push({ kind, at_ms, data: Object.fromEntries(short) });
    if (this.#events.length > MOST_KEPT) this.#events.shift();
  }

  /** Begin to send, since the participant has given consent. */
  begin() {
    this.#consented = true;
  }

  /** Drop all events, since the participant has declined. */
  drop() {
    this.#events = [];
    this.#batch = null;
  }

  /**
   * Send all events if consent was given; on failure keep them for the next time.
   * @returns {Promise<void>} Ends when what was added before is stored, or sending has failed.
   */
  async send() {
    if (!this.#consented || !this.api.token) return;
    this.#sending ??= this.#sendAll().finally(() => (this.#sending = null));
    await this.#sending;
  }

  async #sendAll() {
    try {
      while (this.#next()) await this.#sendBatch(this.#batch);
    } catch {
      // The same batch is sent the next time.
    }
  }

  /** Send all batches at once because the page is being left. */
  leave() {
    if (!this.#consented || !this.api.token) return;
    while (this.#next()) {
      const batch = this.#batch;
      this.#sent(batch);
      this.#sendBatch(batch).catch(() => {});
    }
  }

  /** Return the next batch; it keeps its key until it is stored, so that it is stored once. */
  #next() {
    if (!this.#batch && this.#events.length > 0) {
      this.#batch = { key: newKey(), events: this.#events.slice(0, BATCH) };
    }
    return this.#batch;
  }

  async #sendBatch(batch) {
    try {
      await this.api.tell("/api/events", batch);
    } catch (error) {
      // Another token may be accepted later; any other refusal is final.
      if (!error.code || error.code === "unknown_token") throw error;
    }
    this.#sent(batch);
  }

  #sent(batch) {
    this.#events = this.#events.filter((event) => !batch.events.includes(event));
    if (this.#batch === batch) this.#batch = null;
  }
}
