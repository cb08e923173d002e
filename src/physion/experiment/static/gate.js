/**
 * Requirements of the experiment on device, browser and window.
 * @module gate
 */

import { el, nextFrame } from "./dom.js";

const H264 = 'video/mp4; codecs="avc1.64001f"';
const FRAMES_TIMED = 30;

/**
 * Return why this device or browser cannot be used, as the name of a text of `refusal`, or null.
 * @param {import("./messages.js").PublicStudy} study
 * @returns {"browser"|"movies"|"device"|"screen"|null}
 */
export function deviceProblem(study) {
  const video = el("video");
  if (!video.requestVideoFrameCallback || !window.AbortSignal?.prototype.throwIfAborted) {
    return "browser";
  }
  if (!video.canPlayType(H264)) return "movies";
  if (navigator.maxTouchPoints === 0) return null;
  if (!matchMedia("(any-pointer: fine)").matches) return "device";
  // On computers a small window is reported before trials, where zooming out helps.
  const { width, height } = window.screen;
  const small = width < study.min_width || height < study.min_height;
  return small && matchMedia("(pointer: coarse)").matches ? "screen" : null;
}

/**
 * Return whether the window is large enough for the movies.
 * @param {import("./messages.js").PublicStudy} study
 * @returns {boolean}
 */
export function windowFits(study) {
  return window.innerWidth >= study.min_width && window.innerHeight >= study.min_height;
}

/**
 * Return properties of browser and screen, with the measured refresh rate.
 * @returns {Promise<import("./messages.js").Device>}
 */
export async function measureDevice() {
  return {
    user_agent: navigator.userAgent.slice(0, 1000),
    refresh_hz: await refreshRate(),
    screen_width: window.screen.width,
    screen_height: window.screen.height,
    pixel_ratio: Math.round(window.devicePixelRatio * 1000) / 1000,
    touch: navigator.maxTouchPoints > 0,
  };
}

/**
 * Measure the refresh rate in Hz by the median time between animation frames.
 * @returns {Promise<number|null>} Null if the page is hidden.
 */
async function refreshRate() {
  const hidden = new Promise((resolve) => setTimeout(resolve, 2000, null));
  const timed = (async () => {
    const times = [];
    for (let i = 0; i <= FRAMES_TIMED; i++) times.push(await nextFrame());
    const steps = times.slice(1).map((time, i) => time - times[i]);
    const middle = steps.sort((a, b) => a - b)[FRAMES_TIMED >> 1];
    return middle > 1 ? Math.round(10_000 / middle) / 10 : null;
  })();
  return Promise.race([timed, hidden]);
}
