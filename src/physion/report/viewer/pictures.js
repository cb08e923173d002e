// Pictures that a model saw and imagined, at the frame of the time line: true frames with boxes over
// them, imagined frames, and slots. They change only at the frames of the model.

/** Least width of a canvas, so that lines over a small picture are sharp. */
const CANVAS_WIDTH = 256;

// Pictures of one kind, which lie side by side in one image.
class Sheet {
  constructor(data, onReady) {
    this.data = data;
    createImageBitmap(new Blob([decodeBytes(data.data)], { type: "image/webp" }))
      .then((bitmap) => {
        if (this.closed) return bitmap.close();
        this.bitmap = bitmap;
        onReady();
      })
      .catch(() => {
        this.failed = true;
        onReady();
      });
  }

  close() {
    this.closed = true;
    this.bitmap?.close();
  }

  // Return the row that is shown for a row of the model: itself, or the last one before it.
  shownRow(row) {
    const last = this.data.first + this.data.rows - 1;
    return row < this.data.first ? -1 : Math.min(row, last);
  }

  draw(context, row, part, x, y, width, height) {
    const { first, rows, each, columns, width: w, height: h } = this.data;
    if (!this.bitmap || row < first || row >= first + rows) return;
    const place = (row - first) * each + part;
    const [left, top] = [(place % columns) * w, Math.floor(place / columns) * h];
    context.drawImage(this.bitmap, left, top, w, h, x, y, width, height);
  }
}

// A picture with a caption. `paint` draws on its canvas and returns title and text of the caption.
class Tile {
  constructor(name, width, height, paint) {
    this.canvas = createElement("canvas", { width, height, role: "img", "data-prediction": name });
    this.title = createElement("b");
    this.text = createElement("span");
    this.figure = createElement("figure", { class: "prediction answer" }, this.canvas,
      createElement("figcaption", {}, this.title, " ", this.text));
    this.paint = paint;
  }

  show(row) {
    const context = this.canvas.getContext("2d");
    context.clearRect(0, 0, this.canvas.width, this.canvas.height);
    context.imageSmoothingEnabled = false;
    const [title, text] = this.paint(context, row);
    this.title.textContent = title;
    this.text.textContent = text;
    this.canvas.setAttribute("aria-label", `${title}: ${text}`);
  }
}

class PredictedPictures {
  /** @param {any} data Pictures of one model, see `pack_pictures`. */
  constructor(data) {
    this.data = data;
    this.frame = 0;
    const redraw = () => this.draw();
    this.sheets = Object.fromEntries(["true", "imagined", "masks"].flatMap((name) =>
      data[name] ? [[name, new Sheet(data[name], redraw)]] : []));
    this.tiles = [
      ...(this.sheets.true || data.boxes ? [this.trueTile()] : []),
      ...(this.sheets.imagined ? [this.imaginedTile()] : []),
      ...(this.sheets.masks ? [this.maskTile()] : []),
      ...(data.changes ? [this.changeTile()] : []),
    ];
    this.figures = this.tiles.map(({ figure }) => figure);
  }

  close() {
    for (const sheet of Object.values(this.sheets)) sheet.close();
    for (const figure of this.figures) figure.remove();
  }

  show(frame) {
    this.frame = frame;
    this.draw();
  }

  // Return the last row that is not after the frame, -1 if there is none.
  rowAt(frame) {
    return this.data.frames.findLastIndex((at) => at <= frame);
  }

  draw() {
    const row = this.rowAt(this.frame);
    for (const tile of this.tiles) tile.show(row);
  }

  // Return the text for a row at which nothing is shown.
  before(row) {
    return `from frame ${this.data.frames[row]} on`;
  }

  canvasSize({ width, height }) {
    const factor = Math.ceil(CANVAS_WIDTH / width);
    return [factor * width, factor * height];
  }

  fill(context, sheet, row) {
    sheet?.draw(context, row, 0, 0, 0, context.canvas.width, context.canvas.height);
    return sheet?.failed ? " (this browser cannot decode WebP)" : "";
  }

  trueTile() {
    const { data, sheets } = this;
    const picture = data.true ?? { width: CANVAS_WIDTH, height: CANVAS_WIDTH };
    return new Tile("true", ...this.canvasSize(picture), (context, row) => {
      if (row < 0) return ["Seen", this.before(0)];
      const seen = row < data.seen;
      const at = `frame ${data.frames[row]}`;
      const failed = this.fill(context, sheets.true, row);
      if (data.boxes) this.drawBoxes(context, data.boxes[row] ?? []);
      const size = data.true ? `, ${picture.width} × ${picture.height} px` : "";
      if (!data.boxes) return seen ? ["Seen", `${at}${size}${failed}`] : ["True", `${at}, not seen${failed}`];
      return seen ? ["Boxes seen", `${at}${size}${failed}`]
        : ["Boxes imagined", `${at}, over the true frame, not seen${failed}`];
    });
  }

  drawBoxes(context, boxes) {
    const { width, height } = context.canvas;
    boxes.forEach((box, index) => {
      if (!box) return;
      const [left, top, right, bottom] = box;
      const corner = [left * width, top * height, (right - left) * width, (bottom - top) * height];
      // A dark edge, so that a box is seen on every ground.
      for (const [color, lineWidth] of [["#000a", 5], [this.data.colors.boxes[index % this.data.colors.boxes.length], 3]]) {
        Object.assign(context, { strokeStyle: color, lineWidth });
        context.strokeRect(...corner);
      }
    });
  }

  imaginedTile() {
    const { data, sheets } = this;
    return new Tile("imagined", ...this.canvasSize(data.imagined), (context, row) => {
      if (row < data.seen) return ["Imagined", this.before(data.seen)];
      const failed = this.fill(context, sheets.imagined, row);
      return ["Imagined", `frame ${data.frames[row]}${failed}`];
    });
  }

  maskTile() {
    const { data, sheets } = this;
    const { each, width, height } = data.masks;
    const columns = Math.ceil(Math.sqrt(each));
    const [gap, rows] = [4, Math.ceil(each / columns)];
    const [w, h] = this.canvasSize({ width, height }).map((side) => Math.floor(side / columns));
    const size = [columns * w + (columns - 1) * gap, rows * h + (rows - 1) * gap];
    return new Tile("masks", ...size, (context, row) => {
      const shown = sheets.masks.shownRow(row);
      if (shown < 0) return ["Masks of slots", this.before(data.masks.first)];
      for (let slot = 0; slot < each; slot++) {
        const [x, y] = [(slot % columns) * (w + gap), Math.floor(slot / columns) * (h + gap)];
        sheets.masks.draw(context, shown, slot, x, y, w, h);
      }
      const seen = shown < data.seen ? "seen" : "imagined";
      return ["Masks of slots", `${seen} at frame ${data.frames[shown]}`];
    });
  }

  // How far the slots are from where they were in the last frame that was seen: lines over time, as
  // imagined and, dashed, as the model finds them in the true frames.
  changeTile() {
    const { data } = this;
    const { imagined, true: found } = data.changes;
    const most = Math.max(...[...imagined, ...found].flatMap((values) => values ?? []), 1e-6);
    const [width, height, pad] = [CANVAS_WIDTH, CANVAS_WIDTH, 12];
    const [first, last] = [data.frames[0], data.frames[data.frames.length - 1]];
    const x = (frame) => pad + ((clamp(frame, first, last) - first) / Math.max(last - first, 1)) * (width - 2 * pad);
    const y = (value) => height - pad - (value / most) * (height - 2 * pad);
    const vertical = (context, frame, dash) => {
      context.setLineDash(dash);
      context.beginPath();
      context.moveTo(x(frame), pad);
      context.lineTo(x(frame), height - pad);
      context.stroke();
    };
    const lines = (context, changes, dash) => {
      context.setLineDash(dash);
      (changes.find(Boolean) ?? []).forEach((_, slot) => {
        context.strokeStyle = data.colors.slots[slot];
        context.beginPath();
        changes.forEach((values, row) => {
          if (values) context.lineTo(x(data.frames[row]), y(values[slot]));
        });
        context.stroke();
      });
    };
    return new Tile("changes", width, height, (context, row) => {
      Object.assign(context, { lineWidth: 1, strokeStyle: getComputedStyle(context.canvas).color });
      if (data.seen) vertical(context, data.frames[data.seen - 1], [2, 4]);
      if (row >= 0) vertical(context, data.frames[row], []);
      context.lineWidth = 2;
      lines(context, found, [4, 4]);
      lines(context, imagined, []);
      const since = data.seen ? `since frame ${data.frames[data.seen - 1]}; ` : "";
      return ["Change of slots", `${since}dashed: in the true frames`];
    });
  }
}
