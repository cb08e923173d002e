/**
 * One tab at a time: the tab that was opened last goes on, the one before it stops.
 * @module tabs
 */

/**
 * Take the study over from other tabs of this browser.
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
