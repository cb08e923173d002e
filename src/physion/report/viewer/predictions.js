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
