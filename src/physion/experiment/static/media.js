/**
 * Preloading of the movies and maps of the next trials as blobs, which are freed after use.
 * @module media
 */

import { Refused } from "./api.js";

const AT_ONCE = 2;

/** @typedef {import("./messages.js").TrialMedia} TrialMedia */
/** @typedef {{movie: string, map: string}} Addresses Blob URLs of one trial. */
/**
 * Loading state of one trial's media.
 * @typedef {{stop: AbortController, addresses: Addresses|null, failed: boolean,
 *   promise: Promise<Addresses>|null}} Entry
 */

/** Preloader of a phase's media. */
export class Media {
  /** The trials of the phase by index. @type {Map<number, TrialMedia>} */
  #trials = new Map();
  /** @type {Map<number, Entry>} */
  #entries = new Map();
  #loading = 0;
  #from = 0;
  /** @type {() => Promise<TrialMedia[]>} */
  #renew = async () => [];
  /** @type {Promise<any>|null} */
  #renewal = null;

  /**
   * @param {import("./api.js").Api} api
   * @param {number} ahead Number of trials to load ahead.
   */
  constructor(api, ahead) {
    this.api = api;
    this.ahead = Math.max(1, ahead);
  }

  /**
   * Begin with a list of trials and free the media of the previous list.
   * @param {TrialMedia[]} trials
   * @param {number} from First trial to be shown.
   * @param {() => Promise<TrialMedia[]>} renew Requests the list again, since the URLs may change
   *   when the server restarts.
   */
  start(trials, from, renew) {
    for (const trial of [...this.#entries.keys()]) this.#free(trial);
    this.#trials = byNumber(trials);
    this.#renew = renew;
    this.advance(from);
  }

  /** Free the media before a trial and load those from it on. @param {number} trial */
  advance(trial) {
    this.#from = trial;
    for (const old of [...this.#entries.keys()]) if (old < trial) this.#free(old);
    this.#pump();
  }

  /** Count the trials ahead that are loaded. @returns {{loaded: number, wanted: number}} */
  progress() {
    const wanted = this.#window();
    const loaded = wanted.filter((trial) => this.#entries.get(trial)?.addresses);
    return { loaded: loaded.length, wanted: wanted.length };
  }

  /** Return whether the media of a trial are loaded. @param {number} trial @returns {boolean} */
  isReady(trial) {
    return Boolean(this.#entries.get(trial)?.addresses);
  }

  /**
   * Wait for the media of a trial.
   * @param {number} trial Within the range that `advance` set.
   * @returns {Promise<Addresses>}
   */
  get(trial) {
    if (!this.#entries.has(trial)) this.#load(trial);
    return this.#entries.get(trial).promise;
  }

  /** Load the media of a trial again after they failed to play. @param {number} trial */
  reload(trial) {
    this.#free(trial);
    return this.get(trial);
  }

  /** Return whether loading failed for one of the next trials. @returns {boolean} */
  failed() {
    return this.#window().some((trial) => this.#entries.get(trial)?.failed);
  }

  /** Load again the media that failed. */
  retry() {
    for (const [trial, entry] of [...this.#entries]) if (entry.failed) this.#free(trial);
    this.#pump();
  }

  /** Return the indices of the trials to have loaded. @returns {number[]} */
  #window() {
    return [...this.#trials.keys()].filter(
      (trial) => trial >= this.#from && trial < this.#from + this.ahead,
    );
  }

  /** Start loading while fewer than AT_ONCE trials are being loaded. */
  #pump() {
    for (const trial of this.#window()) {
      if (this.#loading >= AT_ONCE) return;
      if (!this.#entries.has(trial)) this.#load(trial);
    }
  }

  #load(trial) {
    const stop = new AbortController();
    /** @type {Entry} */
    const entry = { stop, addresses: null, failed: false, promise: null };
    this.#loading += 1;
    entry.promise = this.#blobs(trial, stop.signal)
      .then(([movieBlob, mapBlob]) => {
        entry.addresses = {
          movie: URL.createObjectURL(movieBlob),
          map: URL.createObjectURL(mapBlob),
        };
        return entry.addresses;
      })
      .finally(() => {
        this.#loading -= 1;
        this.#pump();
      });
    // Callers of `get` receive the error as well.
    entry.promise.catch(() => (entry.failed = true));
    this.#entries.set(trial, entry);
  }

  /** Fetch movie and map; request new URLs if the server no longer accepts the present ones. */
  async #blobs(trial, signal) {
    const fetched = ({ movie, map }) =>
      Promise.all([movie, map].map((path) => this.api.blob(path, signal)));
    const old = this.#trials.get(trial);
    try {
      return await fetched(old);
    } catch (error) {
      if (!(error instanceof Refused)) throw error;
      if (this.#trials.get(trial) === old) await this.#renewOnce();
      return fetched(this.#trials.get(trial) ?? old);
    }
  }

  /** Request the list of trials again, once for all trials that fail at the same time. */
  #renewOnce() {
    const trials = this.#trials;
    this.#renewal ??= this.#renew()
      .then((list) => this.#trials === trials && (this.#trials = byNumber(list)))
      .finally(() => (this.#renewal = null));
    return this.#renewal;
  }

  #free(trial) {
    const entry = this.#entries.get(trial);
    if (!entry) return;
    entry.stop.abort(new DOMException("no longer needed", "AbortError"));
    for (const address of Object.values(entry.addresses ?? {})) URL.revokeObjectURL(address);
    this.#entries.delete(trial);
  }
}

const byNumber = (trials) => new Map(trials.map((trial) => [trial.trial, trial]));
