// The clock of the detail view. It follows the movie while that plays, or the system's clock if the
// browser cannot play the movie.

class Player {
  /**
   * @param {number} frames Number of frames of the trial.
   * @param {number} baseRate Frames per second at speed 1.
   * @param {any} movie The movie of all passes: data, rate, and stride in frames.
   * @param {(frame: number) => void} onFrame Called when the frame changes.
   * @param {(video: HTMLVideoElement|null) => void} onImage Called with each new image of the
   *   movie, or with null if the movie cannot be played.
   */
  constructor(frames, baseRate, movie, onFrame, onImage) {
    this.frames = frames;
    this.baseRate = baseRate;
    this.movie = movie;
    this.onFrame = onFrame;
    this.onImage = onImage;
    this.limit = frames;
    this.frame = 0;
    this.speed = 1;
    this.playing = false;
    this.failed = false;
    this.url = movieUrl(movie.data);
    this.video = createElement("video", { playsinline: true, preload: "auto" });
    this.video.muted = true;
    this.video.addEventListener("error", () => this.fail());
    this.video.addEventListener("loadeddata", () => this.onImage(this.video));
    this.video.addEventListener("seeked", () => this.onSeeked());
    this.video.src = this.url;
    this.onAnimationFrame = this.onAnimationFrame.bind(this);
    this.request = requestAnimationFrame(this.onAnimationFrame);
    this.onVideoFrame = this.onVideoFrame.bind(this);
    this.video.requestVideoFrameCallback?.(this.onVideoFrame);
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
    this.failed = true;
    this.onImage(null);
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
    this.startTime = performance.now();
    this.startFrame = this.frame;
    if (this.failed) return;
    this.video.playbackRate = (this.speed * this.baseRate) / (this.movie.rate * this.movie.stride);
    this.video.play().catch((error) => {
      // An immediate pause also rejects `play`, which is harmless; only a blocked start is not.
      if (error.name === "NotAllowedError") this.pause();
    });
  }

  pause() {
    this.playing = false;
    this.video.pause();
    // The movie may have advanced by an image before it paused.
    this.seek(this.frame);
  }

  seek(frame) {
    this.frame = clamp(Math.round(frame), 0, this.limit - 1);
    this.presented = undefined;
    this.startTime = performance.now();
    this.startFrame = this.frame;
    if (!this.failed) {
      // Seek to the middle of the image's interval, so that rounding cannot show its neighbour.
      this.seekTime = (Math.floor(this.frame / this.movie.stride) + 0.5) / this.movie.rate;
      if (!this.video.seeking) this.video.currentTime = this.seekTime;
    }
    this.onFrame(this.frame);
  }

  onSeeked() {
    if (this.seekTime !== undefined && Math.abs(this.video.currentTime - this.seekTime) > 1e-3) {
      this.video.currentTime = this.seekTime;
      return;
    }
    this.seekTime = undefined;
    this.onImage(this.video);
  }

  // Follow the image on the screen, in browsers that report it.
  onVideoFrame(_, { mediaTime }) {
    if (this.closed) return;
    this.video.requestVideoFrameCallback(this.onVideoFrame);
    this.presented = mediaTime;
    // After a seek the image may appear later than the event `seeked`.
    this.onImage(this.video);
  }

  currentFrame() {
    if (this.failed) {
      return this.startFrame + ((performance.now() - this.startTime) / 1000) * this.baseRate * this.speed;
    }
    if (this.video.ended) return this.frames;
    const time = this.presented === undefined ? this.video.currentTime : this.presented + 1e-4;
    return Math.floor(time * this.movie.rate + 1e-6) * this.movie.stride;
  }

  onAnimationFrame() {
    this.request = requestAnimationFrame(this.onAnimationFrame);
    if (!this.playing || this.seekTime !== undefined) return;
    const frame = Math.floor(this.currentFrame());
    if (frame >= this.limit) {
      this.seek(0);
      this.play();
      return;
    }
    const hasFrameCallback = "requestVideoFrameCallback" in this.video;
    if (!this.failed && !hasFrameCallback && this.video.readyState >= 2) this.onImage(this.video);
    if (frame !== this.frame) {
      this.frame = frame;
      this.onFrame(frame);
    }
  }
}
