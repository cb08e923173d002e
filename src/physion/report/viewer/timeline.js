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
    if (card.firstContact === null) {
      return [observed, createElement("span", { class: "answer" }, " Agent and patient never touch.")];
    }
    const spans = runs.map(([from, to]) => (from === to ? `${from}` : `${from}–${to}`));
    const shown = spans.slice(0, 8).join(", ");
    const more = spans.length > 8 ? ` and ${spans.length - 8} more` : "";
    const contacts = ` First contact: frame ${card.firstContact}. Agent and patient touch in: ${shown}${more}.`;
    return [observed, createElement("span", { class: "answer" }, contacts)];
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
