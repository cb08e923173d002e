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
    /** Meshes by name, parsed when first needed. @type {any} */
    this.shapes = undefined;
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
    container.hidden = false;
    if (!detail.motion) {
      container.replaceChildren(createElement("p", { class: "note" },
        "Other passes and the 3D view of this trial are not in the page. A page built with more " +
        "details (--details) has them."));
      return;
    }
    const canvas = createElement("canvas", {
      tabindex: 0, role: "application", id: "scene3d",
      "aria-label": "Scene in 3D. Arrow keys rotate it, with shift they move it, plus and minus zoom, 0 returns to the camera of the trial.",
    });
    this.shapes ??= readData("shapes");
    this.scene = new Scene3D(canvas, detail.motion, this.shapes, detail.imagined ?? []);
    if (!this.scene.gl) {
      this.scene = null;
      container.replaceChildren(
        createElement("p", { class: "note" }, "The 3D view needs WebGL 2, which this browser does not offer."),
      );
      return;
    }
    const camera = createElement("button", { type: "button", title: "View of the trial's camera (0)" }, "Camera view");
    camera.onclick = () => this.scene.reset();
    const checkbox = (label, name) => {
      const input = createElement("input", { type: "checkbox", checked: true });
      input.onchange = () => {
        this.scene[name] = input.checked;
        this.scene.draw();
      };
      return createElement("label", {}, input, ` ${label}`);
    };
    const boxes = [checkbox("paths and touch points", "paths")];
    if (detail.motion.bodies.some((body) => body.scenery)) boxes.push(checkbox("scenery", "scenery"));
    const hint = createElement("span", {}, "drag to rotate, wheel to zoom");
    const controls = createElement("div", { class: "controls" }, camera, ...boxes, hint);
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
