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
  if (card.observed) add("while observed", "answer yes");
  if (card.robust !== null) add(`robust ${card.robust.toFixed(2)}`, "answer");
  add(card.split, "");
  if (card.preset) add(card.preset, "");
  return spans;
}
