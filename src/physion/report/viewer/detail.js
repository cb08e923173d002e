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

// The time line: the observed part, the contacts of agent and patient, and the current frame.

class TimeLine {
  constructor(card, runs, seek) {
    this.card = card;
    this.slider = byId("frame-slider");
    this.slider.max = card.frames - 1;
    this.slider.oninput = () => seek(Number(this.slider.value));
    const track = byId("track");
    track.replaceChildren();
    // The ends of the slider are the centres of the first and the last frame.
    this.last = Math.max(card.frames - 1, 1);
    this.addMark(track, "observed", -0.5, card.observedFrames - 0.5);
    for (const [from, to] of runs) this.addMark(track, "contact answer", from - 0.5, to + 0.5);
    if (card.firstContact !== null) this.addMark(track, "first-contact answer", card.firstContact, null);
    byId("marks").replaceChildren(...this.describe(runs));
  }

  addMark(track, kind, from, to) {
    const percent = (frame) => clamp(frame / this.last, 0, 1) * 100;
    const mark = createElement("i", { class: kind });
    mark.style.left = `${percent(from)}%`;
    if (to !== null) mark.style.width = `${percent(to) - percent(from)}%`;
    track.append(mark);
  }

  describe(runs) {
    const { card } = this;
    const observed = `Shaded: the ${card.observedFrames} observed frames.`;
    const pair = card.pair ? [createElement("span", { class: "answer" }, ` Pair: ${card.pair}.`)] : [];
    if (card.firstContact === null) {
      return [observed, ...pair, createElement("span", { class: "answer" }, " Agent and patient never touch.")];
    }
    const spans = runs.map(([from, to]) => (from === to ? `${from}` : `${from}–${to}`));
    const shown = spans.slice(0, 8).join(", ");
    const more = spans.length > 8 ? ` and ${spans.length - 8} more` : "";
    const contacts = ` First contact: frame ${card.firstContact}. Agent and patient touch in: ${shown}${more}.`;
    return [observed, ...pair, createElement("span", { class: "answer" }, contacts)];
  }

  show(frame, frameTime) {
    const part = frame < this.card.observedFrames ? "observed" : "unobserved";
    const physics = (frame * frameTime).toFixed(2);
    const movie = (frame / this.card.rate).toFixed(2);
    this.slider.value = frame;
    this.slider.setAttribute("aria-valuetext", `frame ${frame} of ${this.card.frames}, ${part}`);
    byId("now").replaceChildren(
      `frame ${frame} of ${this.card.frames}, ${part}`, createElement("br"),
      `${physics} s physics, ${movie} s movie`,
    );
  }
}

// Predictions of models: the choice of one, the caption that describes it, and its pictures.

// Say what a model imagined, and how particles are shown.
const describeImagined = ({ caption, particles }) => particles
  ? `Points from frame ${particles.from} on: imagined by ${caption} Agent red, patient yellow, others grey; what is true is paler.`
  : `Seen and imagined by ${caption}`;

class Predictions {
  /**
   * @param {any[]} imagined What each model imagined of the trial.
   * @param {number} chosen Index of the model to be shown, -1 for none.
   * @param {any} after Element that pictures follow.
   * @param {(index: number) => void} onChange Called with the index of the model that is shown.
   */
  constructor(imagined, chosen, after, onChange) {
    this.imagined = imagined;
    this.after = after;
    this.onChange = onChange;
    this.frame = 0;
    const section = byId("prediction");
    section.hidden = imagined.length === 0;
    const options = ["none", ...imagined.map(({ model }) => model)].map((label, row) =>
      createElement("option", { value: row - 1 }, label));
    this.select = createElement("select", { id: "imagined-by", title: "Next prediction (I)" }, ...options);
    this.text = createElement("p", { class: "imagined", "aria-live": "polite" });
    section.replaceChildren(createElement("label", {}, "Prediction ", this.select), this.text);
    this.select.onchange = () => this.update();
    this.select.value = Math.min(chosen, imagined.length - 1);
    this.update();
  }

  close() {
    this.pictures?.close();
    this.pictures = null;
  }

  update() {
    const index = Number(this.select.value);
    this.close();
    const chosen = this.imagined[index];
    this.text.textContent = chosen ? describeImagined(chosen) : "";
    if (chosen?.pictures) {
      this.pictures = new PredictedPictures(chosen.pictures);
      this.after.after(...this.pictures.figures);
      this.pictures.show(this.frame);
    }
    this.onChange(index);
  }

  show(frame) {
    this.frame = frame;
    this.pictures?.show(frame);
  }

  // Draw again, as after a change of the colours.
  draw() {
    this.pictures?.draw();
  }

  // Show the prediction of the next model, after the last one none.
  next() {
    this.select.selectedIndex = (this.select.selectedIndex + 1) % this.select.length;
    this.update();
  }
}

// The detail view of one trial: passes, 3D view, time line and tables, all at the same frame.

const CAPTIONS = {
  color: () => ["Colour", ""],
  depth: ({ near, far }) => ["Depth", `${near.toFixed(1)} (bright) to ${far.toFixed(1)} m`],
  normals: () => ["Normals", "x, y, z: red, green, blue"],
  ids: () => ["Ids", "one colour per object"],
  flow: ({ flow }) => ["Flow", `up to ${flow.toFixed(1)} px per frame`],
};

class Detail {
  /**
   * @param {any[]} cards Data of the trials.
   * @param {() => void} onClose
   */
  constructor(cards, onClose) {
    this.cards = cards;
    this.dialog = byId("detail");
    this.labelsShown = true;
    /** Index of the model whose prediction is shown, -1 for none. */
    this.imaginedBy = 0;
    this.dialog.addEventListener("close", () => {
      this.clear();
      onClose();
    });
    byId("close").onclick = () => this.dialog.close();
    byId("play").onclick = () => this.toggle();
    byId("back").onclick = () => this.step(-1);
    byId("ahead").onclick = () => this.step(1);
    byId("speed").onchange = () => this.player.setSpeed(Number(byId("speed").value));
    this.dialog.addEventListener("keydown", (event) => this.onKey(event));
  }

  open(number) {
    this.clear();
    const card = this.cards[number];
    const detail = readData(`detail-${number}`);
    this.card = card;
    byId("detail-title").textContent = card.trial;
    byId("detail-badges").replaceChildren(...badges(card));
    const movie = detail.passes ?? readData(`movie-${number}`);
    this.buildPasses(movie, detail);
    this.buildScene(detail);
    this.buildPredictions(detail.imagined ?? []);
    this.buildTables(detail.tables);
    this.timeLine = new TimeLine(card, detail.runs, (frame) => this.player.seek(frame));
    this.player = new Player(
      card.frames, card.rate, movie, (frame) => this.show(frame), (video) => this.paint(video),
    );
    this.player.setSpeed(Number(byId("speed").value));
    this.showLabels(this.labelsShown);
    if (!this.dialog.open) this.dialog.showModal();
    this.dialog.scrollTop = 0;
    byId("play").focus();
    this.player.seek(0);
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) this.toggle();
  }

  clear() {
    this.player?.close();
    this.scene?.close();
    this.predictions?.close();
    this.player = this.scene = this.predictions = null;
  }

  buildPasses(movie, detail) {
    this.tiles = movie.tiles.map((name, index) => {
      const { width, height } = movie;
      const canvas = createElement("canvas", { width, height, role: "img", "aria-label": `${name} pass` });
      return { canvas, index, name, width, height };
    });
    const figures = this.tiles.map(({ canvas, name }) => {
      const [title, text] = CAPTIONS[name](detail.ranges ?? {});
      return createElement("figure", {}, canvas, createElement("figcaption", {}, createElement("b", {}, title), " ", text));
    });
    const objects = detail.legend.map(({ name, role, color }) => {
      const swatch = document.createElementNS("http://www.w3.org/2000/svg", "svg");
      const square = document.createElementNS("http://www.w3.org/2000/svg", "rect");
      const [width, height] = ["100%", "100%"];
      for (const [key, value] of Object.entries({ width, height, fill: `rgb(${color.join()})` })) {
        square.setAttribute(key, value);
      }
      swatch.setAttribute("aria-hidden", "true");
      swatch.append(square);
      const label = role ? `${name} (${role})` : name;
      return detail.passes ? createElement("li", {}, swatch, label) : createElement("li", {}, label);
    });
    this.note = createElement("p", { class: "note", hidden: true, role: "status" });
    const legend = createElement(
      "ul", { class: "legend", tabindex: 0, "aria-label": "Objects in the scene" }, ...objects,
    );
    byId("passes").className = detail.passes ? "" : "single";
    byId("passes").replaceChildren(...figures, legend, this.note);
  }

  buildScene(detail) {
    const container = byId("view3d");
    if (!detail.gltf) {
      container.replaceChildren(createElement("p", { class: "note" },
        "Other passes and the 3D view of this trial are not in the page. A page built with more " +
        "details (--details) has them."));
      return;
    }
    const canvas = createElement("canvas", {
      tabindex: 0, role: "application", id: "scene3d",
      "aria-label": "Scene in 3D. Arrow keys rotate it, with shift they move it, plus and minus zoom, 0 returns to the camera of the trial.",
    });
    try {
      this.scene = new Scene3D(canvas, { ...detail, frames: this.card.frames });
    } catch {
      this.scene = null;
      container.replaceChildren(
        createElement("p", { class: "note" }, "The 3D view needs WebGL 2, which this browser does not offer."),
      );
      return;
    }
    const button = (label, title, onclick) =>
      Object.assign(createElement("button", { type: "button", title }, label), { onclick });
    const camera = button("Camera view", "View of the trial's camera (0)", () => this.scene.reset());
    const save = button("Save as glTF", "The scene and its motion, for Blender and other programs", () => {
      const url = URL.createObjectURL(new Blob([decodeBytes(detail.gltf)], { type: "model/gltf-binary" }));
      createElement("a", { href: url, download: `${this.card.trial}.glb` }).click();
      setTimeout(() => URL.revokeObjectURL(url), 10000);
    });
    const checkbox = (label, name) => {
      const input = createElement("input", { type: "checkbox", checked: true });
      input.onchange = () => {
        this.scene[name] = input.checked;
        this.scene.draw();
      };
      return createElement("label", {}, input, ` ${label}`);
    };
    const boxes = [checkbox("paths and touch points", "paths")];
    if (detail.scenery) boxes.push(checkbox("scenery", "scenery"));
    const hint = createElement("span", {}, "drag to rotate, wheel to zoom");
    const controls = createElement("div", { class: "controls" }, camera, ...boxes, save, hint);
    container.replaceChildren(canvas, controls);
  }

  buildPredictions(imagined) {
    this.predictions = new Predictions(imagined, this.imaginedBy, byId("passes").firstElementChild, (index) => {
      // The choice stays for the next trial.
      if (imagined.length) this.imaginedBy = index;
      if (!this.scene) return;
      this.scene.imaginedBy = index;
      this.scene.draw();
    });
  }

  buildTables(tables) {
    byId("tables").replaceChildren(...tables.map(({ title, header, rows, outcome = [] }) => {
      const body = rows.map(([first, ...rest], number) => {
        const cells = rest.map((cell) => createElement("td", {}, cell));
        const className = outcome.includes(number) ? "answer" : null;
        return createElement("tr", { class: className }, createElement("th", { scope: "row" }, first), ...cells);
      });
      const names = (header ?? []).map((name) => createElement("th", { scope: "col" }, name));
      const head = header ? [createElement("thead", {}, createElement("tr", {}, ...names))] : [];
      const table = createElement("table", { class: header ? null : "pairs" }, ...head, createElement("tbody", {}, ...body));
      const scrolling = createElement("div", { class: "scrolling" }, table);
      return createElement("div", { class: header ? "table full-width" : "table" }, createElement("h3", {}, title), scrolling);
    }));
  }

  showLabels(labelsShown) {
    this.labelsShown = labelsShown;
    if (!this.player) return;
    const limit = labelsShown ? this.card.frames : this.card.observedFrames;
    this.player.setLimit(limit);
    if (this.scene) this.scene.limit = limit;
  }

  toggle() {
    if (this.player.playing) this.player.pause();
    else this.player.play();
    byId("play").textContent = this.player.playing ? "Pause" : "Play";
  }

  step(frames) {
    if (this.player.playing) this.toggle();
    this.player.seek(this.player.frame + frames);
  }

  show(frame) {
    if (!this.player) return;
    this.timeLine.show(frame, this.card.frameTime);
    this.scene?.show(frame);
    this.predictions?.show(frame);
    byId("play").textContent = this.player.playing ? "Pause" : "Play";
  }

  // All passes are tiles of one movie, so that they stay synchronous.
  paint(video) {
    if (!video) {
      this.note.hidden = false;
      this.note.textContent = "This browser cannot play the movies (H.264); everything else works.";
      return;
    }
    for (const { canvas, index, width, height } of this.tiles) {
      const source = [index * width, 0, width, height];
      canvas.getContext("2d").drawImage(video, ...source, 0, 0, width, height);
    }
  }

  onKey(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
    const tag = event.target.tagName;
    const usesKeys = tag === "SELECT" || (tag === "INPUT" && event.target.type !== "range");
    const activates = tag === "BUTTON" && (event.key === " " || event.key === "Enter");
    if (usesKeys || activates) return;
    const frames = event.shiftKey ? 10 : 1;
    if (event.key === " ") this.toggle();
    else if (event.key === "ArrowLeft") this.step(-frames);
    else if (event.key === "ArrowRight") this.step(frames);
    else if (event.key === "Home") this.player.seek(0);
    else if (event.key === "End") this.player.seek(this.player.limit - 1);
    else if (event.key === "i" || event.key === "I") this.predictions?.next();
    else if (event.key === "n" || event.key === "N") byId("next").click();
    else if (event.key === "p" || event.key === "P") byId("previous").click();
    else return;
    event.preventDefault();
  }
}
