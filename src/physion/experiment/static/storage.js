/**
 * Persistent storage of token, unsent answers and language. If the browser does not allow storage
 * (as some in private windows), values are kept in memory.
 * @module storage
 */

const memory = new Map();

/**
 * Return a stored value, or null if there is none or it is invalid.
 * @param {string} name
 * @returns {any}
 */
export function recall(name) {
  try {
    const text = window.localStorage.getItem(`physion:${name}`);
    if (text !== null) return JSON.parse(text);
  } catch {
    // An invalid value or forbidden storage must not stop a session.
  }
  return memory.get(name) ?? null;
}

/** Return whether a value would survive a reload. @param {string} name @returns {boolean} */
export function outlivesPage(name) {
  try {
    const text = window.localStorage.getItem(`physion:${name}`);
    return text !== null && text === JSON.stringify(recall(name));
  } catch {
    return false;
  }
}

/** Store a value. @param {string} name @param {any} value Null deletes it. */
export function keep(name, value) {
  memory.set(name, value);
  try {
    if (value === null) window.localStorage.removeItem(`physion:${name}`);
    else window.localStorage.setItem(`physion:${name}`, JSON.stringify(value));
  } catch {
    // Storage is full or forbidden: the value stays in memory while the page is open.
  }
}

/** Draw a 128-bit key. (`crypto.randomUUID` is not available without HTTPS.) @returns {string} */
export function newKey() {
  const bytes = crypto.getRandomValues(new Uint8Array(16));
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join("");
}

/**
 * Take over the study from other tabs of this browser.
 * @param {() => void} onLost Called once when another tab takes it over.
 */
export function takeOver(onLost) {
  if (!("BroadcastChannel" in window)) return;
  const channel = new BroadcastChannel("physion");
  channel.postMessage("mine");
  channel.onmessage = () => {
    channel.close();
    onLost();
  };
}
