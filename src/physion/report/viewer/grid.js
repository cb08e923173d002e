// The grid of cards by scenario, with filters, and the playback of their movies.

class Grid {
  /**
   * @param {any[]} cards Data of the trials.
   * @param {Record<string, number>} totals Numbers of trials in the dataset by scenario.
   * @param {(number: number) => void} open Opens a trial.
   */
  constructor(cards, totals, open) {
    this.cards = cards;
    this.totals = totals;
    this.open = open;
    this.playing = !matchMedia("(prefers-reduced-motion: reduce)").matches;
    this.labelled = true;
    this.visible = new Set();
    this.watcher = new IntersectionObserver((entries) => this.seen(entries), { rootMargin: "100px" });
    this.build();
    this.fillFilters();
    const form = byId("filters");
    form.addEventListener("input", () => this.apply());
    form.addEventListener("reset", () => setTimeout(() => this.apply()));
    form.addEventListener("submit", (event) => event.preventDefault());
    byId("movies").onclick = () => this.setPlaying(!this.playing);
    this.setPlaying(this.playing);
    this.apply();
    this.step = this.step.bind(this);
    requestAnimationFrame(this.step);
  }

  build() {
    this.items = this.cards.map((card, number) => this.item(card, number));
    const scenarios = [...new Set(this.cards.map((card) => card.scenario))];
    this.sections = scenarios.map((scenario) => {
      const note = make("small");
      const list = make("ul");
      this.items.forEach(({ card, element }) => card.scenario === scenario && list.append(element));
      const section = make("section", {}, make("h2", {}, scenario, note), list);
      return { scenario, note, section };
    });
    byId("grid").replaceChildren(...this.sections.map(({ section }) => section));
  }

  item(card, number) {
    const video = make("video", { playsinline: true, loop: true, "aria-hidden": true, tabindex: -1 });
    video.muted = true;
    Object.assign(video, { width: card.width, height: card.height });
    const words = make("span", { class: "words" }, ...badges(card));
    const button = make("button", { type: "button", class: "card" }, video, make("b", {}, card.trial), words);
    button.onclick = () => this.open(number);
    this.watcher.observe(video);
    const item = { card, number, video, button, element: make("li", {}, button) };
    video.item = item;
    return item;
  }

  fillFilters() {
    for (const name of ["scenario", "split", "preset"]) {
      const values = [...new Set(this.cards.map((card) => card[name]))].filter(Boolean).sort();
      const options = values.map((value) => make("option", { value }, value));
      byId(name).replaceChildren(make("option", { value: "" }, "all"), ...options);
      byId(name).disabled = values.length < 2;
    }
    if (this.cards.every((card) => card.robust === null)) {
      byId("robust").disabled = true;
      byId("robust-value").textContent = "not measured";
    }
  }

  matches(card) {
    const value = (id) => byId(id).value;
    const agrees = (wanted, fact) => !wanted || (wanted === "yes") === fact;
    const words = value("search").toLowerCase().split(/\s+/).filter(Boolean);
    const least = Number(value("robust"));
    return (
      ["scenario", "split", "preset"].every((name) => !value(name) || card[name] === value(name)) &&
      words.every((word) => card.words.includes(word)) &&
      // Filters by the outcome would reveal it.
      (!this.labelled ||
        (agrees(value("contact"), card.contact) &&
          agrees(value("observed"), card.observed) &&
          (least === 0 || (card.robust !== null && card.robust >= least))))
    );
  }

  apply() {
    if (!byId("robust").disabled) {
      const least = Number(byId("robust").value);
      byId("robust-value").textContent = least === 0 ? "any" : `${least.toFixed(3)} or more`;
    }
    for (const item of this.items) item.element.hidden = !this.matches(item.card);
    this.chosen = this.items.filter((item) => !item.element.hidden);
    for (const { scenario, note, section } of this.sections) {
      const all = this.cards.filter((card) => card.scenario === scenario).length;
      const here = this.chosen.filter((item) => item.card.scenario === scenario).length;
      const left = this.totals[scenario] - all;
      section.hidden = here === 0;
      note.textContent = `${here === all ? here : `${here} of ${all}`} shown` +
        (left > 0 ? `, ${left} more in the dataset but not in this page` : "");
    }
    const total = Object.values(this.totals).reduce((sum, count) => sum + count, 0);
    const left = total - this.cards.length;
    byId("count").textContent =
      `${this.chosen.length} of ${plural(this.cards.length, "trial")} shown; ` +
      (left > 0 ? `${plural(left, "trial")} of the dataset left out of this page.` : "nothing of the dataset left out.");
  }

  setLabelled(labelled) {
    this.labelled = labelled;
    this.apply();
  }

  setPlaying(playing) {
    this.playing = playing;
    byId("movies").textContent = playing ? "Movies play" : "Movies stand";
    for (const video of this.visible) this.run(video);
  }

  // Pause the movies while an open trial covers the grid.
  setCovered(covered) {
    this.covered = covered;
    for (const video of this.visible) this.run(video);
  }

  run(video) {
    if (this.playing && !this.covered) video.play().catch(() => {});
    else video.pause();
  }

  // Load movies when they become visible, since browsers limit the number of loaded movies.
  seen(entries) {
    for (const { target: video, isIntersecting } of entries) {
      if (isIntersecting && !this.visible.has(video)) {
        this.visible.add(video);
        video.url ??= movieUrl(block(`movie-${video.item.number}`).data);
        video.src = video.url;
        this.run(video);
      } else if (!isIntersecting && this.visible.delete(video)) {
        video.removeAttribute("src");
        video.load();
        URL.revokeObjectURL(video.url);
        video.url = undefined;
      }
    }
  }

  // With hidden labels, restart movies at the end of the observed part.
  step() {
    requestAnimationFrame(this.step);
    if (this.labelled) return;
    for (const video of this.visible) {
      const { observedFrames, rate } = video.item.card;
      if (video.currentTime > (observedFrames - 2) / rate) video.currentTime = 0;
    }
  }
}
