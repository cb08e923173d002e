/**
 * One tab at a time: the tab opened last continues, earlier ones stop.
 * @module tabs
 */

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
