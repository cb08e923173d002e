// Refreshes the content of the overview in place, so that reading and scrolling are not disturbed.
// Without scripts the page loads itself anew instead.

const SECONDS = 30;

async function refresh() {
  if (document.hidden) return;
  const address = new URL(location.href);
  address.searchParams.set("auto", "1");
  let response;
  try {
    response = await fetch(address, { credentials: "same-origin" });
  } catch {
    return; // Offline, or the server starts anew: the next time.
  }
  if (response.redirected) location.reload(); // The login is over.
  if (!response.ok) return;
  const page = new DOMParser().parseFromString(await response.text(), "text/html");
  document.querySelector("main").replaceWith(page.querySelector("main"));
}

setInterval(refresh, SECONDS * 1000);
