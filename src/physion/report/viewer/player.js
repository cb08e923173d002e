// The clock of the detail view. It follows the movie while that plays, or the system's clock if the
// browser cannot play the movie.

class Player {
  /**
   * @param {number} frames Number of frames of the trial.
   * @param {number} baseRate Frames per second at speed 1.
   * @param {any} strip The movie of all passes: data, rate, and stride in frames.
   * @param {(frame: number) => void} onFrame Called when the frame changes.
   * @param {(video: HTMLVideoElement|null) => void} onPicture Called with each new picture of the
   *   movie, or with null if the movie cannot be played.
   */
  constructor(frames, baseRate, strip, onFrame, onPicture) {
    this.frames = frames;
    this.baseRate = baseRate;
    this.strip = strip;
    this.onFrame = onFrame;
    this.onPicture = onPicture;
    this.limit = frames;
    this.frame = 0;
    this.speed = 1;
    this.playing = false;
    this.broken = false;
    this.url = movieUrl(strip.data);
    this.video = make("video", { playsinline: true, preload: "auto" });
    this.video.muted = true;
    this.video.addEventListener("error", () => this.fail());
    this.video.addEventListener("loadeddata", () => this.onPicture(this.video));
    this.video.addEventListener("seeked", () => this.sought());
    this.video.src = this.url;
    this.draw = this.draw.bind(this);
    this.request = requestAnimationFrame(this.draw);
    this.picture = this.picture.bind(this);
    this.video.requestVideoFrameCallback?.(this.picture);
  }

  close() {
    this.closed = true;
    this.playing = false;
    cancelAnimationFrame(this.request);
    this.video.pause();
    this.video.removeAttribute("src");
    URL.revokeObjectURL(this.url);
  }

  fail() {
    // Removing the movie in `close` is not a failure.
    if (this.closed) return;
    this.broken = true;
    this.onPicture(null);
    if (this.playing) this.play();
  }

  setLimit(frames) {
    this.limit = clamp(frames, 1, this.frames);
    if (this.frame >= this.limit) this.seek(this.limit - 1);
  }

  setSpeed(speed) {
    this.speed = speed;
    if (this.playing) this.play();
  }

  play() {
    if (this.frame >= this.limit - 1) this.seek(0);
    this.playing = true;
    this.since = performance.now();
    this.from = this.frame;
    if (this.broken) return;
    this.video.playbackRate = (this.speed * this.baseRate) / (this.strip.rate * this.strip.stride);
    this.video.play().catch((error) => {
      // An immediate pause also rejects `play`, which is harmless; only a blocked start is not.
      if (error.name === "NotAllowedError") this.pause();
    });
  }

  pause() {
    this.playing = false;
    this.video.pause();
    // The movie may have advanced by a picture before it paused.
    this.seek(this.frame);
  }

  seek(frame) {
    this.frame = clamp(Math.round(frame), 0, this.limit - 1);
    this.presented = undefined;
    this.since = performance.now();
    this.from = this.frame;
    if (!this.broken) {
      // Seek to the middle of the picture's interval, so that rounding cannot show its neighbour.
      this.wanted = (Math.floor(this.frame / this.strip.stride) + 0.5) / this.strip.rate;
      if (!this.video.seeking) this.video.currentTime = this.wanted;
    }
    this.onFrame(this.frame);
  }

  sought() {
    if (this.wanted !== undefined && Math.abs(this.video.currentTime - this.wanted) > 1e-3) {
      this.video.currentTime = this.wanted;
      return;
    }
    this.wanted = undefined;
    this.onPicture(this.video);
  }

  // Follow the picture on the screen, in browsers that report it.
  picture(_, { mediaTime }) {
    if (this.closed) return;
    this.video.requestVideoFrameCallback(this.picture);
    this.presented = mediaTime;
    // After a seek the picture may appear later than the event `seeked`.
    this.onPicture(this.video);
  }

  now() {
    if (this.broken) {
      return this.from + ((performance.now() - this.since) / 1000) * this.baseRate * this.speed;
    }
    if (this.video.ended) return this.frames;
    const time = this.presented === undefined ? this.video.currentTime : this.presented + 1e-4;
    return Math.floor(time * this.strip.rate + 1e-6) * this.strip.stride;
  }

  draw() {
    this.request = requestAnimationFrame(this.draw);
    if (!this.playing || this.wanted !== undefined) return;
    const frame = Math.floor(this.now());
    if (frame >= this.limit) {
      this.seek(0);
      this.play();
      return;
    }
    const reports = "requestVideoFrameCallback" in this.video;
    if (!this.broken && !reports && this.video.readyState >= 2) this.onPicture(this.video);
    if (frame !== this.frame) {
      this.frame = frame;
      this.onFrame(frame);
    }
  }
}
