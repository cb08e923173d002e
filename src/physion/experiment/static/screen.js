/**
 * Display of stimuli: a movie, the map of agent and patient above it, and a cover that hides both.
 * Flashes the map, plays the movie, and records the frames that were actually presented.
 * @module screen
 */

import { el, nextFrame, sleep } from "./dom.js";

const STALLED_MS = 3_000;
const LOADED_MS = 10_000;
const FIRST_FRAME_MS = 1_000;

/** Raised when the movie could not be shown. `reason`: load, play or stalled. */
export class MovieFailed extends Error {
  /** @param {string} reason @param {string} [detail] */
  constructor(reason, detail = "") {
    super(`${reason} ${detail}`.trim());
    this.reason = reason;
  }
}

/**
 * Counter of the different frames that were presented, from the reports of
 * requestVideoFrameCallback. Callbacks can be missed: if the browser's counter `presentedFrames`
 * grew by more than one, that many of the frames between two reports count as presented too. A frame
 * that is presented twice counts once, also when a busy browser reports frames out of order.
 */
export class FrameCount {
  /** Frames that were presented. @type {Set<number>} */
  #presented = new Set();

  /** @param {number} rate Frames per second of the movie. */
  constructor(rate) {
    this.rate = rate;
    /** `mediaTime` of the first frame in seconds. */
    this.origin = 0;
    /** Time (ms), frame, counter of presented frames. @type {Array<[number, number, number]>} */
    this.seen = [];
  }

  /** Number of different frames that were presented. */
  get shown() {
    return this.#presented.size;
  }

  /**
   * Add a report.
   * @param {number} now Time in ms.
   * @param {{mediaTime: number, presentedFrames: number}} metadata
   */
  add(now, { mediaTime, presentedFrames }) {
    const frame = Math.round((mediaTime - this.origin) * this.rate);
    const [, before, counted] = this.seen.at(-1) ?? [now, frame, presentedFrames];
    const missed = presentedFrames - counted - 1;
    // Which of the frames between were presented is unknown, only how many.
    for (let k = 0; k <= missed && frame - k > before; k += 1) this.#presented.add(frame - k);
    this.#presented.add(frame);
    this.seen.push([now, frame, presentedFrames]);
  }
}

/** The stimulus display of one trial. */
export class Screen {
  /** @type {FrameCount|null} */
  #frames = null;
  #stop;

  /**
   * @param {{width: number, height: number, rate: number}} media
   * @param {AbortSignal} stop Ends flashing and playing.
   */
  constructor(media, stop) {
    this.media = media;
    this.#stop = stop;
    this.video = el("video", {
      class: "screen-movie",
      playsinline: true,
      disablepictureinpicture: true,
      disableremoteplayback: true,
      preload: "auto",
      tabindex: "-1",
      "aria-hidden": "true",
    });
    this.video.muted = true;
    this.map = el("img", { class: "screen-map", alt: "", hidden: true });
    this.cover = el("div", { class: "screen-cover" });
    this.element = el("div", { class: "screen" }, this.video, this.map, this.cover);
    this.element.style.setProperty("--ratio", String(media.width / media.height));
  }

  /**
   * Load movie and map behind the cover and wait until the first frame is painted.
   * @param {{movie: string, map?: string}} addresses
   */
  async load({ movie, map }) {
    this.#frames = new FrameCount(this.media.rate);
    const loaded = new Promise((resolve, reject) => {
      this.video.onloadeddata = resolve;
      this.video.onerror = () => reject(new MovieFailed("load", this.video.error?.message));
      setTimeout(() => reject(new MovieFailed("load", "timeout")), LOADED_MS);
    });
    loaded.catch(() => {}); // the map may fail first
    const painted = new Promise((resolve) => this.#watch(resolve));
    this.video.src = movie;
    if (map) {
      this.map.src = map;
      const decoded = this.map.decode();
      await decoded.catch(() => Promise.reject(new MovieFailed("load", "map")));
    }
    await loaded;
    // Some browsers report no frame before the movie plays, although it is painted.
    await Promise.race([painted, sleep(FIRST_FRAME_MS)]);
    await nextFrame();
  }

  /** Record each presented frame from now on. @param {(value?: any) => void} onFrame */
  #watch(onFrame) {
    const frames = this.#frames;
    const record = (now, metadata) => {
      if (this.#frames !== frames) return;
      // WebKitGTK's times include the offset in the edit list of the movie.
      if (this.video.paused && this.video.currentTime === 0) frames.origin = metadata.mediaTime;
      frames.add(now, metadata);
      onFrame();
      this.video.requestVideoFrameCallback(record);
    };
    this.video.requestVideoFrameCallback(record);
  }

  /** Cover or uncover movie and map. @param {boolean} hidden */
  hide(hidden) {
    this.cover.hidden = !hidden;
  }

  /**
   * Flash the map above the still first frame: whole cycles only, each beginning with the map on,
   * in step with the animation frames.
   * @param {{ms: number, hz: number}} cue With `hz` 0 the map is on all the time.
   * @returns {Promise<{ms: number, changes: Array<[number, boolean]>}>} The actual duration, and
   *   the times in ms at which the map was switched on and off, since the first frame was shown.
   */
  async flash({ ms, hz }) {
    const cycles = Math.floor((ms * hz) / 1000 + 1e-6);
    const start = await nextFrame();
    const changes = [];
    let on = false;
    const set = (value, at) => {
      if (value === on) return;
      on = value;
      this.map.hidden = !value;
      changes.push([round(at), value]);
    };
    this.hide(false);
    let before = start;
    for (let now = start; ; now = await nextFrame()) {
      this.#stop.throwIfAborted();
      const at = now - start;
      // Switch at the animation frame nearest to the nominal time, not at the first one after it.
      const ahead = Math.min(now - before, 20) / 2;
      before = now;
      if (at + ahead >= ms) {
        set(false, at);
        return { ms: round(at), changes };
      }
      const halves = Math.floor(((at + ahead) * hz * 2) / 1000);
      set(hz === 0 || (halves < cycles * 2 && halves % 2 === 0), at);
    }
  }

  /**
   * Play the loaded movie to its end.
   * @param {{hide: boolean}} options Whether to cover the movie at its end.
   * @returns {Promise<{ms: number, startMs: number, ended: number}>} Duration of the movie, time
   *   until it started, and the time of its end.
   */
  async play({ hide }) {
    const video = this.video;
    const watch = new AbortController();
    const signal = watch.signal;
    /** @type {(error: any) => void} */
    let failed;
    /** @type {(at: number) => void} */
    let ended;
    /** @type {Promise<number>} */
    const end = new Promise((resolve, reject) => ([ended, failed] = [resolve, reject]));
    const on = (target, name, listener) => target.addEventListener(name, listener, { signal });
    on(this.#stop, "abort", () => failed(this.#stop.reason));
    on(video, "error", () => failed(new MovieFailed("play", video.error?.message)));
    on(video, "ended", () => {
      if (hide) this.hide(true);
      ended(performance.now());
    });
    // Browsers pause silent movies of hidden pages.
    const resume = () => !document.hidden && !video.ended && video.play().catch(() => {});
    on(document, "visibilitychange", resume);
    const timer = this.#watchStall(failed);
    const start = performance.now();
    try {
      this.#stop.throwIfAborted();
      await Promise.race([
        video.play().catch((error) => {
          if (!document.hidden) throw new MovieFailed("play", error.message);
        }),
        end,
      ]);
      const begun = performance.now();
      const at = await end;
      return { ms: round(at - begun), ended: at, startMs: round(begun - start) };
    } finally {
      clearInterval(timer);
      watch.abort();
    }
  }

  /** Call `failed` when the visible movie has not advanced for STALLED_MS. */
  #watchStall(failed) {
    let time = -1;
    let moved = performance.now();
    return setInterval(() => {
      const now = performance.now();
      if (document.hidden || this.video.currentTime !== time) moved = now;
      time = this.video.currentTime;
      if (now - moved > STALLED_MS) failed(new MovieFailed("stalled", `at ${time} s`));
    }, 250);
  }

  /** Release the video decoder, since browsers limit the number of loaded movies. */
  release() {
    this.video.onerror = null;
    this.video.removeAttribute("src");
    this.video.load();
  }

  /**
   * Return what was presented since `load`. Call it some time after the end of the movie, because
   * the last reports arrive after the last frame.
   * @returns {{shown: number, dropped: number|null, seen: Array<[number, number, number]>}}
   */
  record() {
    const quality = this.video.getVideoPlaybackQuality?.();
    return {
      shown: this.#frames?.shown ?? 0,
      dropped: quality ? quality.droppedVideoFrames : null,
      seen: this.#frames?.seen ?? [],
    };
  }
}

/** Round milliseconds to one decimal. @param {number} ms @returns {number} */
export const round = (ms) => Math.round(ms * 10) / 10;
