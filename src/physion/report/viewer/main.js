// The page: the grid, the trial that is looked at, and its name in the address.

const cards = block("cards");
const title = document.title;

const named = () => {
  const match = /^#trial=(.*)$/.exec(location.hash);
  if (!match) return -1;
  try {
    const name = decodeURIComponent(match[1]);
    return cards.findIndex((card) => card.trial === name);
  } catch {
    return -1;
  }
};

const address = (hash) => {
  if (location.hash !== hash) history.replaceState(null, "", hash || location.pathname + location.search);
};

let open = -1;
const detail = new Detail(cards, () => {
  grid.rest(false);
  grid.items[open]?.button.focus();
  open = -1;
  document.title = title;
  address("");
});
const show = (number) => {
  open = number;
  grid.rest(true);
  document.title = `${cards[number].trial} – ${title}`;
  detail.open(number);
  address(`#trial=${encodeURIComponent(cards[number].trial)}`);
};
const grid = new Grid(cards, block("totals"), show);

// To the next or previous trial of those that the filters leave.
const turn = (by) => {
  const numbers = grid.chosen.map((item) => item.number);
  const place = numbers.indexOf(open);
  if (numbers.length) show(numbers[(place + by + numbers.length) % numbers.length]);
};
byId("next").onclick = () => turn(1);
byId("previous").onclick = () => turn(-1);

byId("labels").onclick = () => {
  const labelled = !grid.labelled;
  document.body.classList.toggle("unlabelled", !labelled);
  byId("labels").textContent = labelled ? "Labels shown" : "Labels hidden";
  grid.setLabelled(labelled);
  detail.setLabelled(labelled);
};

addEventListener("hashchange", () => named() >= 0 && named() !== open && show(named()));
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => detail.scene?.draw());
if (named() >= 0) show(named());
