// The page: helpers, the grid of cards with its filters, and the open trial in the address.

// DOM helpers and decoding of data. Text of trials becomes text nodes and attributes, never markup.

/** @param {string} id @returns {any} */
const byId = (id) => document.getElementById(id);

/**
 * Create an element.
 * @param {string} tag
 * @param {Record<string, any>} [attributes] `true` gives an empty attribute; `false` and `null` none.
 * @param {...(Node|string)} children
 * @returns {any}
 */
function createElement(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value !== null && value !== false) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children);
  return element;
}

// Parse a JSON block of the page.
const readData = (id) => JSON.parse(byId(id).textContent);

// Decode base64.
function decodeBytes(base64) {
  const text = atob(base64);
  const array = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) array[i] = text.charCodeAt(i);
  return array;
}

// Decode base64 to a typed array.
const decodeArray = (base64, Kind) => new Kind(decodeBytes(base64).buffer);

// Decode points that are quantised to 16 bits within their bounding box.
function decodePoints(grid) {
  const steps = decodeArray(grid.data, Uint16Array);
  const points = new Float32Array(steps.length);
  for (let i = 0; i < steps.length; i++) {
    points[i] = grid.low[i % 3] + (steps[i] / 65535) * grid.size[i % 3];
  }
  return points;
}

const movieUrl = (base64) =>
  URL.createObjectURL(new Blob([decodeBytes(base64)], { type: "video/mp4" }));

const plural = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

// Short facts about a trial; those that reveal the outcome have a class by which they can be hidden.
function badges(card) {
  const spans = [];
  const add = (label, kind) => spans.push(createElement("span", { class: `badge ${kind}` }, label));
  add(card.contact ? `contact at ${card.firstContact}` : "no contact", `answer ${card.contact ? "yes" : ""}`);
  if (card.pair) add(card.pair, "answer");
  if (card.observed) add("while observed", "answer yes");
  if (card.robust !== null) add(`robust ${card.robust.toFixed(2)}`, "answer");
  add(card.split, "");
  if (card.preset) add(card.preset, "");
  if (card.outside.length) add(`beyond the picture: ${card.outside.join(", ")}`, "");
  if (card.unusable) add(`unusable: ${card.unusable}`, "yes");
  return spans;
}

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
    this.labelsShown = true;
    this.visible = new Set();
    this.observer = new IntersectionObserver((entries) => this.onVisibilityChange(entries), { rootMargin: "100px" });
    this.build();
    this.fillFilters();
    const form = byId("filters");
    form.addEventListener("input", () => this.applyFilters());
    form.addEventListener("reset", () => setTimeout(() => this.applyFilters()));
    form.addEventListener("submit", (event) => event.preventDefault());
    byId("movies").onclick = () => this.setPlaying(!this.playing);
    this.setPlaying(this.playing);
    this.applyFilters();
    this.onAnimationFrame = this.onAnimationFrame.bind(this);
    requestAnimationFrame(this.onAnimationFrame);
  }

  build() {
    this.items = this.cards.map((card, number) => this.item(card, number));
    const scenarios = [...new Set(this.cards.map((card) => card.scenario))];
    this.sections = scenarios.map((scenario) => {
      const note = createElement("small");
      const list = createElement("ul");
      this.items.forEach(({ card, element }) => card.scenario === scenario && list.append(element));
      const section = createElement("section", {}, createElement("h2", {}, scenario, note), list);
      return { scenario, note, section };
    });
    byId("grid").replaceChildren(...this.sections.map(({ section }) => section));
  }

  item(card, number) {
    const video = createElement("video", { playsinline: true, loop: true, "aria-hidden": true, tabindex: -1 });
    video.muted = true;
    Object.assign(video, { width: card.width, height: card.height });
    const badgeRow = createElement("span", { class: "badges" }, ...badges(card));
    const refresh = () => badgeRow.replaceChildren(...badges(card));
    const button = createElement("button", { type: "button", class: "card" }, video, createElement("b", {}, card.trial), badgeRow);
    button.onclick = () => this.open(number);
    this.observer.observe(video);
    const item = { card, number, video, button, refresh, element: createElement("li", {}, button) };
    video.item = item;
    return item;
  }

  fillFilters() {
    for (const name of ["scenario", "split", "preset"]) {
      const values = [...new Set(this.cards.map((card) => card[name]))].filter(Boolean).sort();
      const options = values.map((value) => createElement("option", { value }, value));
      byId(name).replaceChildren(createElement("option", { value: "" }, "all"), ...options);
      byId(name).disabled = values.length < 2;
    }
    if (this.cards.every((card) => card.robust === null)) {
      byId("robust").disabled = true;
      byId("robust-value").textContent = "not measured";
    }
  }

  matches(card) {
    const value = (id) => byId(id).value;
    const outcomeIs = (wanted, fact) => !wanted || (wanted === "yes") === fact;
    const terms = value("search").toLowerCase().split(/\s+/).filter(Boolean);
    const minimum = Number(value("robust"));
    return (
      ["scenario", "split", "preset"].every((name) => !value(name) || card[name] === value(name)) &&
      terms.every((term) => card.searchText.includes(term)) &&
      // Filters by the outcome would reveal it.
      (!this.labelsShown ||
        (outcomeIs(value("contact"), card.contact) &&
          outcomeIs(value("observed"), card.observed) &&
          (minimum === 0 || (card.robust !== null && card.robust >= minimum))))
    );
  }

  applyFilters() {
    if (!byId("robust").disabled) {
      const minimum = Number(byId("robust").value);
      byId("robust-value").textContent = minimum === 0 ? "any" : `${minimum.toFixed(3)} or more`;
    }
    for (const item of this.items) item.element.hidden = !this.matches(item.card);
    this.shown = this.items.filter((item) => !item.element.hidden);
    for (const { scenario, note, section } of this.sections) {
      const inPage = this.cards.filter((card) => card.scenario === scenario).length;
      const matching = this.shown.filter((item) => item.card.scenario === scenario).length;
      const notInPage = this.totals[scenario] - inPage;
      section.hidden = matching === 0;
      note.textContent = `${matching === inPage ? matching : `${matching} of ${inPage}`} shown` +
        (notInPage > 0 ? `, ${notInPage} more in the dataset but not in this page` : "");
    }
    const total = Object.values(this.totals).reduce((sum, count) => sum + count, 0);
    const notInPage = total - this.cards.length;
    byId("count").textContent =
      `${this.shown.length} of ${plural(this.cards.length, "trial")} shown; ` +
      (notInPage > 0 ? `${plural(notInPage, "trial")} of the dataset left out of this page.` : "nothing of the dataset left out.");
  }

  showLabels(labelsShown) {
    this.labelsShown = labelsShown;
    this.applyFilters();
  }

  setPlaying(playing) {
    this.playing = playing;
    byId("movies").textContent = playing ? "Movies play" : "Movies paused";
    for (const video of this.visible) this.updatePlayback(video);
  }

  // Pause the movies while an open trial covers the grid.
  setCovered(covered) {
    this.covered = covered;
    for (const video of this.visible) this.updatePlayback(video);
  }

  updatePlayback(video) {
    if (this.playing && !this.covered) video.play().catch(() => {});
    else video.pause();
  }

  // Load movies when they become visible, since browsers limit the number of loaded movies.
  onVisibilityChange(entries) {
    for (const { target: video, isIntersecting } of entries) {
      if (isIntersecting && !this.visible.has(video)) {
        this.visible.add(video);
        video.url ??= movieUrl(readData(`movie-${video.item.number}`).data);
        video.src = video.url;
        this.updatePlayback(video);
      } else if (!isIntersecting && this.visible.delete(video)) {
        video.removeAttribute("src");
        video.load();
        URL.revokeObjectURL(video.url);
        video.url = undefined;
      }
    }
  }

  // With hidden labels, restart movies at the end of the observed part.
  onAnimationFrame() {
    requestAnimationFrame(this.onAnimationFrame);
    if (this.labelsShown) return;
    for (const video of this.visible) {
      const { observedFrames, rate } = video.item.card;
      if (video.currentTime > (observedFrames - 2) / rate) video.currentTime = 0;
    }
  }
}

// The page: the grid, the open trial, and its name in the URL.

const cards = readData("cards");
const title = document.title;

// Return the number of the trial that the URL names, -1 for none.
const namedTrial = () => {
  const match = /^#trial=(.*)$/.exec(location.hash);
  if (!match) return -1;
  try {
    const name = decodeURIComponent(match[1]);
    return cards.findIndex((card) => card.trial === name);
  } catch {
    return -1;
  }
};

const setHash = (hash) => {
  if (location.hash !== hash) history.replaceState(null, "", hash || location.pathname + location.search);
};

let openTrial = -1;
const detail = new Detail(cards, () => {
  grid.setCovered(false);
  grid.items[openTrial]?.button.focus();
  openTrial = -1;
  document.title = title;
  setHash("");
});
const show = (number) => {
  openTrial = number;
  grid.setCovered(true);
  document.title = `${cards[number].trial} – ${title}`;
  detail.open(number);
  showMark();
  setHash(`#trial=${encodeURIComponent(cards[number].trial)}`);
};
const grid = new Grid(cards, readData("totals"), show);

// Show the next (1) or previous (-1) of the trials that match the filters.
const showNeighbour = (by) => {
  const numbers = grid.shown.map((item) => item.number);
  const index = numbers.indexOf(openTrial);
  if (numbers.length) show(numbers[(index + by + numbers.length) % numbers.length]);
};
byId("next").onclick = () => showNeighbour(1);
byId("previous").onclick = () => showNeighbour(-1);

// Marks of unusable trials: a page cannot write files, so it offers the file for the dataset's folder.
const marks = readData("unusable");

const showMark = () => {
  const { trial } = cards[openTrial];
  byId("reason").value = marks[trial] ?? "";
  byId("mark").textContent = marks[trial] ? "Change or clear the mark" : "Mark as unusable";
};
byId("mark").onclick = () => {
  const card = cards[openTrial];
  const reason = byId("reason").value.trim().replace(/\s+/g, " ");
  if (!reason && !marks[card.trial]) return byId("reason").focus();
  if (reason) marks[card.trial] = reason;
  else delete marks[card.trial];
  card.unusable = reason;
  window.onbeforeunload = (event) => event.preventDefault(); // asks before marks are lost
  grid.items[openTrial].refresh();
  byId("detail-badges").replaceChildren(...badges(card));
  byId("save-marks").hidden = false;
  byId("save-marks").textContent = `Save unusable.csv (${Object.keys(marks).length})`;
  byId("save-marks").title = "Put the file into the folder of the dataset";
  showMark();
};
byId("save-marks").onclick = () => {
  const quoted = (text) => `"${text.replaceAll('"', '""')}"`;
  const rows = Object.entries(marks).sort(([a], [b]) => (a < b ? -1 : 1));
  const lines = ["trial,reason", ...rows.map((row) => row.map(quoted).join(","))];
  const href = URL.createObjectURL(new Blob([`${lines.join("\n")}\n`], { type: "text/csv" }));
  createElement("a", { href, download: "unusable.csv" }).click();
  window.onbeforeunload = null;
};

byId("labels").onclick = () => {
  const labelsShown = !grid.labelsShown;
  document.body.classList.toggle("unlabelled", !labelsShown);
  byId("labels").textContent = labelsShown ? "Labels shown" : "Labels hidden";
  grid.showLabels(labelsShown);
  detail.showLabels(labelsShown);
};

addEventListener("hashchange", () => {
  const number = namedTrial();
  if (number >= 0 && number !== openTrial) show(number);
});
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  detail.scene?.draw();
  detail.predictions?.draw();
});
if (namedTrial() >= 0) show(namedTrial());
