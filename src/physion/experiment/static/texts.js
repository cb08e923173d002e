/**
 * The words of the pages, from the study's texts in one language.
 * @module texts
 */

export class Texts {
  /**
   * @param {string} language
   * @param {Object<string, string>} words By dotted key.
   */
  constructor(language, words) {
    this.language = language;
    this.words = words;
  }

  /**
   * The text of a key, with its {placeholders} filled in. The result is text, never markup.
   * @param {string} key
   * @param {Object<string, string|number>} [values]
   * @returns {string}
   */
  t(key, values = {}) {
    const text = this.words[key];
    if (text === undefined) {
      console.error(`the texts of ${this.language} have no ${key}`);
      return key;
    }
    return text.replace(/\{(\w+)\}/g, (whole, name) =>
      name in values ? String(values[name]) : whole,
    );
  }

  /** @param {string} key @returns {boolean} */
  has(key) {
    return key in this.words;
  }
}

/**
 * The language to begin with: what was asked for, else what the browser prefers, else the first.
 * @param {string[]} offered
 * @param {(string|null)[]} wanted In order of preference.
 * @returns {string}
 */
export function chooseLanguage(offered, wanted) {
  for (const tag of [...wanted, ...(navigator.languages ?? [])]) {
    const found = offeredLanguage(offered, tag);
    if (found) return found;
  }
  return offered[0];
}

/** The one that a tag means: `de-AT` means `de`. @returns {string|undefined} */
export function offeredLanguage(offered, tag) {
  const short = (tag ?? "").toLowerCase().split("-")[0];
  return offered.find((language) => language === tag || language === short);
}
