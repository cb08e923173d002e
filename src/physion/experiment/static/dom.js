/**
 * Elements built without HTML text, so that no value can ever become markup.
 * @module dom
 */

/**
 * Make an element.
 * @param {string} tag
 * @param {Object<string, any>} [attributes] `onclick` and the like take functions; `true` gives an
 *   empty attribute; `false`, `null` and `undefined` none.
 * @param {...(Node|string|null)} children Strings become text.
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

/**
 * Plain text as paragraphs: an empty line ends one; lines that begin with "- " make a list.
 * @param {string} text
 * @returns {HTMLElement[]}
 */
export function paragraphs(text) {
  return text
    .trim()
    .split(/\n\s*\n/)
    .map((block) => {
      const lines = block.trim().split("\n");
      if (!lines.every((line) => line.startsWith("- "))) return el("p", {}, lines.join(" "));
      return el("ul", {}, ...lines.map((line) => el("li", {}, line.slice(2))));
    });
}

/**
 * A button.
 * @param {string} label
 * @param {() => void} onclick
 * @param {Object<string, any>} [attributes]
 * @returns {HTMLButtonElement}
 */
export function button(label, onclick, attributes = {}) {
  return el("button", { type: "button", class: "button", onclick, ...attributes }, label);
}

/** Resolves in the next frame of the screen, with its time. @returns {Promise<number>} */
export const nextFrame = () => new Promise((resolve) => requestAnimationFrame(resolve));

/** Resolves after so many milliseconds. @param {number} ms @returns {Promise<void>} */
export const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

/** Resolves as soon as the page can be seen. @returns {Promise<void>} */
export function pageVisible() {
  if (!document.hidden) return Promise.resolve();
  return new Promise((resolve) => {
    const seen = () => {
      if (document.hidden) return;
      document.removeEventListener("visibilitychange", seen);
      resolve();
    };
    document.addEventListener("visibilitychange", seen);
  });
}
