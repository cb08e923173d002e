/**
 * Random keys.
 * @module random_key
 */

/** Draw a 128-bit key. (`crypto.randomUUID` is not available without HTTPS.) @returns {string} */
export function newKey() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}
