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
    this.labelled = true;
    this.dialog.addEventListener("close", () => {
      this.clear();
      onClose();
    });
    byId("close").onclick = () => this.dialog.close();
    byId("play").onclick = () => this.toggle();
    byId("back").onclick = () => this.step(-1);
    byId("ahead").onclick = () => this.step(1);
    byId("speed").onchange = () => this.player.setSpeed(Number(byId("speed").value));
    this.dialog.addEventListener("keydown", (event) => this.key(event));
  }

  open(number) {
    this.clear();
    const card = this.cards[number];
    const detail = block(`detail-${number}`);
    this.card = card;
    byId("detail-title").textContent = card.trial;
    byId("detail-badges").replaceChildren(...badges(card));
    const strip = detail.passes ?? block(`movie-${number}`);
    this.buildPasses(strip, detail);
    this.buildScene(detail);
    this.buildTables(detail.tables);
    this.line = new TimeLine(card, detail.runs, (frame) => this.player.seek(frame));
    this.player = new Player(
      card.frames, card.rate, strip, (frame) => this.show(frame), (video) => this.paint(video),
    );
    this.player.setSpeed(Number(byId("speed").value));
    this.setLabelled(this.labelled);
    if (!this.dialog.open) this.dialog.showModal();
    this.dialog.scrollTop = 0;
    byId("play").focus();
    this.player.seek(0);
    if (!matchMedia("(prefers-reduced-motion: reduce)").matches) this.toggle();
  }

  clear() {
    this.player?.close();
    this.scene?.close();
    this.player = this.scene = null;
  }

  buildPasses(strip, detail) {
    this.tiles = strip.tiles.map((name, index) => {
      const { width, height } = strip;
      const canvas = make("canvas", { width, height, role: "img", "aria-label": `${name} pass` });
      return { canvas, index, name, width, height };
    });
    const figures = this.tiles.map(({ canvas, name }) => {
      const [title, text] = CAPTIONS[name](detail.ranges ?? {});
      return make("figure", {}, canvas, make("figcaption", {}, make("b", {}, title), " ", text));
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
      return detail.passes ? make("li", {}, swatch, label) : make("li", {}, label);
    });
    this.note = make("p", { class: "note", hidden: true, role: "status" });
    const legend = make(
      "ul", { class: "legend", tabindex: 0, "aria-label": "Objects in the scene" }, ...objects,
    );
    byId("passes").className = detail.passes ? "" : "alone";
    byId("passes").replaceChildren(...figures, legend, this.note);
  }

  buildScene(detail) {
    const container = byId("solid");
    container.hidden = false;
    if (!detail.motion) {
      container.replaceChildren(make("p", { class: "note" },
        "Other passes and the 3D view of this trial are not in the page. A page built with more " +
        "details (--details) has them."));
      return;
    }
    const canvas = make("canvas", {
      tabindex: 0, role: "application", id: "scene3d",
      "aria-label": "Scene in 3D. Arrow keys rotate it, with shift they move it, plus and minus zoom, 0 returns to the camera of the trial.",
    });
    this.shapes ??= block("shapes");
    this.scene = new Scene3D(canvas, detail.motion, this.shapes);
    if (!this.scene.gl) {
      this.scene = null;
      container.replaceChildren(
        make("p", { class: "note" }, "The 3D view needs WebGL 2, which this browser does not offer."),
      );
      return;
    }
    const camera = make("button", { type: "button", title: "View of the trial's camera (0)" }, "Camera view");
    camera.onclick = () => this.scene.reset();
    const check = (label, name) => {
      const box = make("input", { type: "checkbox", checked: true });
      box.onchange = () => {
        this.scene[name] = box.checked;
        this.scene.draw();
      };
      return make("label", {}, box, ` ${label}`);
    };
    const boxes = [check("paths and touch points", "paths")];
    if (detail.motion.bodies.some((body) => body.scenery)) boxes.push(check("scenery", "scenery"));
    const hint = make("span", {}, "drag to rotate, wheel to zoom");
    container.replaceChildren(canvas, make("div", { class: "under" }, camera, ...boxes, hint));
  }

  buildTables(tables) {
    byId("tables").replaceChildren(...tables.map(({ title, header, rows, outcome = [] }) => {
      const body = rows.map(([first, ...rest], number) => {
        const cells = rest.map((cell) => make("td", {}, cell));
        const hides = outcome.includes(number) ? "answer" : null;
        return make("tr", { class: hides }, make("th", { scope: "row" }, first), ...cells);
      });
      const names = (header ?? []).map((name) => make("th", { scope: "col" }, name));
      const head = header ? [make("thead", {}, make("tr", {}, ...names))] : [];
      const table = make("table", { class: header ? null : "pairs" }, ...head, make("tbody", {}, ...body));
      const wide = make("div", { class: "wide" }, table);
      return make("div", { class: header ? "table broad" : "table" }, make("h3", {}, title), wide);
    }));
  }

  setLabelled(labelled) {
    this.labelled = labelled;
    if (!this.player) return;
    const limit = labelled ? this.card.frames : this.card.observedFrames;
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
    this.line.show(frame, this.card.frameTime);
    this.scene?.show(frame);
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

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || event.defaultPrevented) return;
    const kind = event.target.tagName;
    const busy = kind === "SELECT" || (kind === "INPUT" && event.target.type !== "range");
    const pressed = kind === "BUTTON" && (event.key === " " || event.key === "Enter");
    if (busy || pressed) return;
    const far = event.shiftKey ? 10 : 1;
    if (event.key === " ") this.toggle();
    else if (event.key === "ArrowLeft") this.step(-far);
    else if (event.key === "ArrowRight") this.step(far);
    else if (event.key === "Home") this.player.seek(0);
    else if (event.key === "End") this.player.seek(this.player.limit - 1);
    else if (event.key === "n" || event.key === "N") byId("next").click();
    else if (event.key === "p" || event.key === "P") byId("previous").click();
    else return;
    event.preventDefault();
  }
}
