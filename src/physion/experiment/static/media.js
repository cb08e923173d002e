/**
 * Movies and maps of the next trials, loaded as blobs before they are needed and freed after.
 * @module media
 */

import { Refused } from "./api.js";

const AT_ONCE = 2;

/** @typedef {{movie: string, map: string}} Addresses Blob addresses of one trial. */

export class Media {
  #trials = new Map();
  #entries = new Map();
  #loading = 0;
  #from = 0;
  #renew = async () => [];
  #renewal = null;

  /**
   * @param {import("./api.js").Api} api
   * @param {number} ahead So many trials are loaded before they are shown.
   */
  constructor(api, ahead) {
    this.api = api;
    this.ahead = Math.max(1, ahead);
  }

  /**
   * Begin with a list of trials; what another list held is freed.
   * @param {Array<{trial: number, movie: string, map: string}>} trials
   * @param {number} from First trial to be shown.
   * @param {() => Promise<any[]>} renew Asks for the list anew: after the server was started again
   *   it may have other addresses.
   */
  start(trials, from, renew) {
    for (const trial of [...this.#entries.keys()]) this.#free(trial);
    this.#trials = byNumber(trials);
    this.#renew = renew;
    this.advance(from);
  }

  /** The trial is next: free what lies behind it, load what lies ahead. @param {number} trial */
  advance(trial) {
    this.#from = trial;
    for (const old of [...this.#entries.keys()]) if (old < trial) this.#free(old);
    this.#pump();
  }

  /** How many of the trials ahead are loaded. @returns {{loaded: number, wanted: number}} */
  progress() {
    const wanted = this.#window();
    const loaded = wanted.filter((trial) => this.#entries.get(trial)?.addresses);
    return { loaded: loaded.length, wanted: wanted.length };
  }

  /** @param {number} trial @returns {boolean} */
  isReady(trial) {
    return Boolean(this.#entries.get(trial)?.addresses);
  }

  /**
   * The media of a trial, as soon as they are there.
   * @param {number} trial In the window that `advance` set.
   * @returns {Promise<Addresses>}
   */
  get(trial) {
    if (!this.#entries.has(trial)) this.#load(trial);
    return this.#entries.get(trial).promise;
  }

  /** Load a trial's media anew, after they failed to play. @param {number} trial */
  reload(trial) {
    this.#free(trial);
    return this.get(trial);
  }

  /** Were media refused that the next trials need? */
  failed() {
    return this.#window().some((trial) => this.#entries.get(trial)?.failed);
  }

  /** Load anew what failed. */
  retry() {
    for (const [trial, entry] of [...this.#entries]) if (entry.failed) this.#free(trial);
    this.#pump();
  }

  #window() {
    return [...this.#trials.keys()].filter(
      (trial) => trial >= this.#from && trial < this.#from + this.ahead,
    );
  }

  #pump() {
    for (const trial of this.#window()) {
      if (this.#loading >= AT_ONCE) return;
      if (!this.#entries.has(trial)) this.#load(trial);
    }
  }

  #load(trial) {
    const stop = new AbortController();
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
    // Whoever asks for the trial is told as well.
    entry.promise.catch(() => (entry.failed = true));
    this.#entries.set(trial, entry);
  }

  /** Movie and map, by new addresses where the server does not take those that it gave. */
  async #blobs(trial, signal) {
    const fetched = ({ movie, map }) =>
      Promise.all([movie, map].map((path) => this.api.blob(path, signal)));
    const old = this.#trials.get(trial);
    try {
      return await fetched(old);
    } catch (error) {
      if (!(error instanceof Refused)) throw error;
      if (this.#trials.get(trial) === old) await this.#askAnew();
      return fetched(this.#trials.get(trial) ?? old);
    }
  }

  /** Once for all trials that fail at the same time. */
  #askAnew() {
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
