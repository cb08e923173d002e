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
