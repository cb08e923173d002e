/**
 * @module random_key
 */

/** A key that nobody else has. `crypto.randomUUID` is missing outside https. @returns {string} */
export function newKey() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}
