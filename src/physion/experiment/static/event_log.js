/**
 * What else happens in the browser (hidden, offline, errors, ...), sent in batches and never waited
 * for: losing one loses no data of the study.
 * @module event_log
 */

const DAY_MS = 86_400_000;
const BATCH = 50;
const MOST_KEPT = 500;
const EVERY_MS = 5_000;

export class EventLog {
  #events = [];
  #sending = false;

  /** @param {import("./api.js").Api} api */
  constructor(api) {
    this.api = api;
    setInterval(() => this.send(), EVERY_MS);
    window.addEventListener("pagehide", () => this.send());
    document.addEventListener("visibilitychange", () => {
      this.add(document.hidden ? "hidden" : "visible");
      if (document.hidden) this.send();
    });
    window.addEventListener("online", () => this.add("online"));
    window.addEventListener("offline", () => this.add("offline"));
    window.addEventListener("error", (event) => this.add("error", { message: event.message }));
    window.addEventListener("unhandledrejection", (event) =>
      this.add("error", { message: String(event.reason) }),
    );
    let resizing = 0;
    window.addEventListener("resize", () => {
      clearTimeout(resizing);
      const size = () => ({ width: window.innerWidth, height: window.innerHeight });
      resizing = setTimeout(() => this.add("resized", size()), 300);
    });
  }

  /**
   * @param {string} kind Lower case letters and "_".
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

  /** Send what there is, if anybody has entered; what fails stays for the next time. */
  async send() {
    if (this.#sending || this.#events.length === 0 || !this.api.token) return;
    this.#sending = true;
    const batch = this.#events.slice(0, BATCH);
    try {
      await this.api.tell("/api/events", { events: batch });
      this.#events = this.#events.filter((event) => !batch.includes(event));
    } catch (error) {
      // A refusal will not become better by trying again; anything else may.
      if (error.code) this.#events = this.#events.filter((event) => !batch.includes(event));
    } finally {
      this.#sending = false;
    }
  }
}
