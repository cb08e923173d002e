/**
 * Texts of the pages in one language, from the study's files.
 * @module texts
 */

/** The texts of one language. */
export class Texts {
  /**
   * @param {string} language
   * @param {Object<string, string>} words Texts by dotted key.
   */
  constructor(language, words) {
    this.language = language;
    this.words = words;
    /** Scenario of the session, which may have texts of its own. */
    this.scenario = "";
    /** Condition of the session, which may have texts of its own too. */
    this.condition = "";
  }

  /**
   * Return the text of a key with its {placeholders} filled in, as plain text.
   * @param {string} key
   * @param {Record<string, any>} [values] Strings and numbers by placeholder.
   * @returns {string}
   */
  t(key, values = {}) {
    const text = this.words[this.#place(key)];
    if (text === undefined) {
      console.error(`the texts of ${this.language} have no ${key}`);
      return key;
    }
    return text.replace(/\{(\w+)\}/g, (whole, name) =>
      name in values ? String(values[name]) : whole,
    );
  }

  /** Return whether there is a text for a key. @param {string} key @returns {boolean} */
  has(key) {
    return this.#place(key) in this.words;
  }

  /** Return the key of the text that stands in place of `key` in this condition and scenario. */
  #place(key) {
    const own = [`condition.${this.condition}.${key}`, `scenario.${this.scenario}.${key}`];
    return own.find((special) => special in this.words) ?? key;
  }
}

/** Return the method `t` of the texts, bound, for destructuring. @param {Texts} texts */
export function bound(texts) {
  return { t: texts.t.bind(texts) };
}

/**
 * Choose the first language: a wanted one, else one that the browser prefers, else the first.
 * @param {string[]} offered Languages of the study.
 * @param {(string|null)[]} wanted Language tags in order of preference.
 * @returns {string}
 */
export function chooseLanguage(offered, wanted) {
  for (const tag of [...wanted, ...(navigator.languages ?? [])]) {
    const language = offeredLanguage(offered, tag);
    if (language) return language;
  }
  return offered[0];
}

/**
 * Return the offered language that matches a tag: `de-AT` matches `de`.
 * @param {string[]} offered
 * @param {string|null} tag
 * @returns {string|undefined}
 */
export function offeredLanguage(offered, tag) {
  const short = (tag ?? "").toLowerCase().split("-")[0];
  return offered.find((language) => language === tag || language === short);
}
