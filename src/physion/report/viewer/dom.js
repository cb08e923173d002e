// Elements, text and numbers. Text from trials becomes text nodes and attributes, never markup.

const byId = (id) => document.getElementById(id);

function make(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value !== null && value !== false) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children);
  return element;
}

const block = (id) => JSON.parse(byId(id).textContent);

function bytes(base64) {
  const text = atob(base64);
  const array = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) array[i] = text.charCodeAt(i);
  return array;
}

const numbers = (base64, Kind) => new Kind(bytes(base64).buffer);

// Points that were stored on a grid over their bounds.
function gridPoints(grid) {
  const steps = numbers(grid.data, Uint16Array);
  const points = new Float32Array(steps.length);
  for (let i = 0; i < steps.length; i++) {
    points[i] = grid.low[i % 3] + (steps[i] / 65535) * grid.size[i % 3];
  }
  return points;
}

const movieUrl = (base64) =>
  URL.createObjectURL(new Blob([bytes(base64)], { type: "video/mp4" }));

const plural = (count, noun) => `${count} ${noun}${count === 1 ? "" : "s"}`;

const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

// Short facts of a trial; those that give the answer away can be hidden by their class.
function badges(card) {
  const found = [];
  const add = (words, kind) => found.push(make("span", { class: `badge ${kind}` }, words));
  add(card.contact ? `contact at ${card.first}` : "no contact", `answer ${card.contact ? "yes" : ""}`);
  if (card.observed) add("while observed", "answer yes");
  if (card.robust !== null) add(`robust ${card.robust.toFixed(2)}`, "answer");
  add(card.split, "");
  if (card.preset) add(card.preset, "");
  return found;
}
