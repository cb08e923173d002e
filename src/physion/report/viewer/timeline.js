// The time line: the observed part, the contacts of agent and patient, and the current frame.

class TimeLine {
  constructor(card, runs, seek) {
    this.card = card;
    this.scrub = byId("scrub");
    this.scrub.max = card.frames - 1;
    this.scrub.oninput = () => seek(Number(this.scrub.value));
    const track = byId("track");
    track.replaceChildren();
    // The ends of the slider are the centres of the first and the last frame.
    this.last = Math.max(card.frames - 1, 1);
    this.mark(track, "seen", -0.5, card.observedFrames - 0.5);
    for (const [from, to] of runs) this.mark(track, "touch answer", from - 0.5, to + 0.5);
    if (card.first !== null) this.mark(track, "first answer", card.first, null);
    byId("marks").replaceChildren(...this.words(runs));
  }

  mark(track, kind, from, to) {
    const percent = (frame) => clamp(frame / this.last, 0, 1) * 100;
    const mark = make("i", { class: kind });
    mark.style.left = `${percent(from)}%`;
    if (to !== null) mark.style.width = `${percent(to) - percent(from)}%`;
    track.append(mark);
  }

  words(runs) {
    const { card } = this;
    const seen = `Shaded: the ${card.observedFrames} observed frames.`;
    if (card.first === null) {
      return [seen, make("span", { class: "answer" }, " Agent and patient never touch.")];
    }
    const spans = runs.map(([from, to]) => (from === to ? `${from}` : `${from}–${to}`));
    const shown = spans.slice(0, 8).join(", ");
    const more = spans.length > 8 ? ` and ${spans.length - 8} more` : "";
    const touch = ` First contact: frame ${card.first}. Agent and patient touch in: ${shown}${more}.`;
    return [seen, make("span", { class: "answer" }, touch)];
  }

  show(frame, frameTime) {
    const part = frame < this.card.observedFrames ? "observed" : "unobserved";
    const physics = (frame * frameTime).toFixed(2);
    const movie = (frame / this.card.rate).toFixed(2);
    this.scrub.value = frame;
    this.scrub.setAttribute("aria-valuetext", `frame ${frame} of ${this.card.frames}, ${part}`);
    byId("now").replaceChildren(
      `frame ${frame} of ${this.card.frames}, ${part}`, make("br"),
      `${physics} s physics, ${movie} s movie`,
    );
  }
}
