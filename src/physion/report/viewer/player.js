// One clock for everything that moves in the detail view. The movie is the clock while it plays;
// where the browser cannot play it, the time of day is.

class Player {
  constructor(frames, baseRate, strip, onFrame, onPicture) {
    Object.assign(this, { frames, baseRate, strip, onFrame, onPicture });
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
    // Taking the movie away at the end is no failure of it.
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
      // A pause that follows at once rejects the play; only then is nothing wrong.
      if (error.name === "NotAllowedError") this.pause();
    });
  }

  pause() {
    this.playing = false;
    this.video.pause();
    // The movie may have gone on by a picture before it stood.
    this.seek(this.frame);
  }

  seek(frame) {
    this.frame = clamp(Math.round(frame), 0, this.limit - 1);
    this.presented = undefined;
    this.since = performance.now();
    this.from = this.frame;
    if (!this.broken) {
      // The middle of a picture's time, so that rounding cannot show its neighbour.
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

  // Where browsers tell which picture is on the screen, everything else follows that picture.
  picture(_, { mediaTime }) {
    if (this.closed) return;
    this.video.requestVideoFrameCallback(this.picture);
    this.presented = mediaTime;
    // After a seek the picture may come to the screen later than the seek is said to be over.
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
    const told = "requestVideoFrameCallback" in this.video;
    if (!this.broken && !told && this.video.readyState >= 2) this.onPicture(this.video);
    if (frame !== this.frame) {
      this.frame = frame;
      this.onFrame(frame);
    }
  }
}
