/**
 * Which devices, browsers and windows the experiment works on.
 * @module gate
 */

import { el, nextFrame } from "./dom.js";

const H264 = 'video/mp4; codecs="avc1.64001f"';
const FRAMES_TIMED = 30;

/**
 * Why this device or browser will not do: the name of a text of `refusal`, or null.
 * @param {any} study `PublicStudy`
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
  // Computers say how small the window is where it matters: zooming out helps there.
  const { width, height } = window.screen;
  const small = width < study.min_width || height < study.min_height;
  return small && matchMedia("(pointer: coarse)").matches ? "screen" : null;
}

/** Is the window as large as the movies need it? @param {any} study @returns {boolean} */
export function windowFits(study) {
  return window.innerWidth >= study.min_width && window.innerHeight >= study.min_height;
}

/** A `Device`: what is used, and the measured refresh rate of the screen. */
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

/** From the median time between frames of the screen; null where the page is not shown. */
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
