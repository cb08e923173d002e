// Refreshes the content of the overview in place, without disturbing reading and scrolling.
// Without scripts the page reloads itself instead.

const SECONDS = 30;

/** Replace the content by that of a newly fetched page. */
async function refresh() {
  if (document.hidden) return;
  const address = new URL(location.href);
  address.searchParams.set("auto", "1");
  let response;
  try {
    response = await fetch(address, { credentials: "same-origin" });
  } catch {
    return; // Offline, or the server is restarting: try again the next time.
  }
  if (response.redirected) location.reload(); // The login has expired.
  if (!response.ok) return;
  const page = new DOMParser().parseFromString(await response.text(), "text/html");
  document.querySelector("main").replaceWith(page.querySelector("main"));
}

setInterval(refresh, SECONDS * 1000);
