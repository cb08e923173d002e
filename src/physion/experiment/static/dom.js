/**
 * DOM helpers. Elements are built without HTML source, so that no value can become markup.
 * @module dom
 */

/**
 * Create an element.
 * @param {string} tag
 * @param {Object<string, any>} [attributes] Functions are event listeners (`onclick`, ...); `true`
 *   gives an empty attribute; `false`, `null` and `undefined` give none.
 * @param {...(Node|string|null)} children Strings become text nodes; null is skipped.
 * @returns {any} The element.
 */
export function el(tag, attributes = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(attributes)) {
    if (value === false || value === null || value === undefined) continue;
    if (typeof value === "function") element.addEventListener(name.slice(2), value);
    else element.setAttribute(name, value === true ? "" : String(value));
  }
  element.append(...children.filter((child) => child !== null));
  return element;
}

const ADDRESS = /(https:\/\/[^\s<>"']*[^\s<>"'.,;:!?)])/;

/**
 * Split a text at its https addresses, which become links that open in another tab.
 * @param {string} text
 * @returns {Array<Node|string>}
 */
function linked(text) {
  return text.split(ADDRESS).map((part, index) => {
    if (index % 2 === 0) return part;
    return el("a", { href: part, target: "_blank", rel: "noopener noreferrer" }, part);
  });
}

/**
 * Convert plain text to paragraphs, separated by empty lines; lines that begin with "- " form a
 * list, and https addresses become links.
 * @param {string} text
 * @returns {HTMLElement[]}
 */
export function paragraphs(text) {
  return text
    .trim()
    .split(/\n\s*\n/)
    .map((block) => {
      const lines = block.trim().split("\n");
      if (!lines.every((line) => line.startsWith("- "))) {
        return el("p", {}, ...linked(lines.join(" ")));
      }
      return el("ul", {}, ...lines.map((line) => el("li", {}, ...linked(line.slice(2)))));
    });
}

/**
 * Create a button.
 * @param {string} label
 * @param {() => void} onclick
 * @param {Object<string, any>} [attributes]
 * @returns {HTMLButtonElement}
 */
export function button(label, onclick, attributes = {}) {
  return el("button", { type: "button", class: "button", onclick, ...attributes }, label);
}

/** Wait for the next animation frame and return its time. @returns {Promise<number>} */
export const nextFrame = () => new Promise((resolve) => requestAnimationFrame(resolve));

/** Wait for some milliseconds. @param {number} ms @returns {Promise<void>} */
export const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/** Wait until the page is visible. @returns {Promise<void>} */
export function pageVisible() {
  if (!document.hidden) return Promise.resolve();
  return new Promise((resolve) => {
    const changed = () => {
      if (document.hidden) return;
      document.removeEventListener("visibilitychange", changed);
      resolve();
    };
    document.addEventListener("visibilitychange", changed);
  });
}
