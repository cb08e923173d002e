"""Helpers of browser tests: take part in a study with a real browser on a real server.

Chromium is the one named by $PHYSION_BROWSER, else that of the system. With $PHYSION_SCREENSHOTS a
screenshot of every page is written to that folder.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
import sqlalchemy as sa

from physion.experiment.server_process import ServerProcess
from physion.experiment.store.database import ANSWERS, EVENTS, SESSIONS, open_database
from physion.experiment.study.identity import Secrets, participant_hash
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.settings import Plausibility, Recruitment, Timing
from physion.experiment.study.study import Study
from support.experiment.tiny_study import make_tiny_study
from support.programs import absent, find_chromium, find_firefox

SIZE = {"width": 1280, "height": 800}
FAST = Plausibility(reading_s=0.0, fast_ms=0)
"""Rules of plausible sessions under which a test may read and answer faster than people do."""
SHORT = Timing(fixation_ms=(60, 120), cue_ms=500, flash_hz=2.0)
MTURK = "https://workersandbox.mturk.com"
OFFLINE = re.compile(
    r"ERR_(INTERNET_DISCONNECTED|CONNECTION_(REFUSED|RESET)|EMPTY_RESPONSE)|status of (409|425|503)"
)
"""Console messages of browsers about requests that a test lets fail, or that are sent again: on a
slow machine the server may learn so late of a movie that its answer seems too early."""
HIDE = """
hidden => {
  const set = (name, value) => Object.defineProperty(document, name, {value, configurable: true});
  set("hidden", hidden);
  set("visibilityState", hidden ? "hidden" : "visible");
  document.dispatchEvent(new Event("visibilitychange"));
}"""
"""Function of the page that hides it, or shows it again, as far as its scripts can tell."""


# One for each file of tests: while it runs, its event loop blocks this thread for others.
@pytest.fixture(scope="module")
def driver() -> Iterator[Any]:
    """Playwright; skips the tests if it is not installed."""
    if importlib.util.find_spec("playwright") is None:
        absent("playwright is absent: install the extra 'dev'")
    with importlib.import_module("playwright.sync_api").sync_playwright() as playwright:
        yield playwright


@pytest.fixture(scope="module")
def chromium(driver: Any) -> Iterator[Any]:
    """A running Chromium; skips the tests if there is none."""
    browser = driver.chromium.launch(
        executable_path=find_chromium(), args=["--no-sandbox"], timeout=120_000
    )
    yield browser
    browser.close()


@pytest.fixture(scope="module")
def firefox(driver: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A running Firefox; `firefox_bridge` stands between it and Playwright."""
    bridge = Path(__file__).with_name("firefox_bridge.py")
    start = tmp_path_factory.mktemp("firefox") / "start"
    command = shlex.join([sys.executable, str(bridge), find_firefox()])
    start.write_text(f'#!/bin/sh\nexec {command} "$@"\n')
    start.chmod(0o700)
    browser = driver.firefox.launch(channel="moz-firefox", executable_path=start, timeout=120_000)
    yield browser
    browser.close()


@contextlib.contextmanager
def served(folder: Path, **settings: Any) -> Iterator[tuple[Study, ServerProcess]]:
    """Serve a tiny study by its own server process."""
    given: dict[str, Any] = {
        "test": 3,
        "familiarization": 1,
        "timing": SHORT,
        "plausibility": FAST,
        "recruitment": Recruitment(link_code="TINY-CODE", link_address="https://lab.example/done"),
    }
    study = make_tiny_study(folder, **{**given, **settings})
    with ServerProcess(study.folder) as server:
        yield study, server


def answers_to_test(study: Study, raw_id: str) -> list[Any]:
    """Return the answers of a person to test trials, in order."""
    return [row for row in rows_of(study, raw_id)[1] if row.phase == "test"]


def signed_query(study: Study, raw_id: str) -> str:
    """Return the query of a link that continues a person's session in another browser."""
    key = make_pass(Secrets.load(study.folder), "person", "link", raw_id)
    return f"?participant={raw_id}&pass={key}"


class Visit:
    """One participant's browser: performs the steps of a session and records console errors."""

    def __init__(self, chromium: Any, url: str, name: str = "", **context: Any) -> None:
        self.url, self.name = url, name
        self.complaints: list[str] = []
        self.requests: list[str] = []
        self.context = chromium.new_context(**{"viewport": SIZE, "locale": "en-US", **context})
        self.context.set_default_timeout(60_000)
        self.page = self.open_tab()
        self._pictures = 0

    def open_tab(self) -> Any:
        """Open another tab of the same browser."""
        page = self.context.new_page()
        page.on("console", lambda message: self._console(message))
        page.on("pageerror", lambda error: self.complaints.append(f"error: {error}"))
        page.on("request", lambda request: self.requests.append(request.url))
        return page

    def _console(self, message: Any) -> None:
        if message.type in ("error", "warning"):
            self.complaints.append(f"{message.type}: {message.text}")

    def __enter__(self) -> Visit:
        return self

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if kind is not None and "PHYSION_SCREENSHOTS" in os.environ:
            self.picture("failed")
        self.context.close()

    def hosts(self) -> set[str]:
        """Return the hosts of all requests, without blob URLs."""
        return {urlsplit(url).netloc for url in self.requests if not url.startswith("blob:")}

    def unexpected(self) -> list[str]:
        """Return the console errors but those of `OFFLINE`."""
        return [line for line in self.complaints if not OFFLINE.search(line)]

    def picture(self, what: str) -> None:
        """Write a screenshot if $PHYSION_SCREENSHOTS is set."""
        folder = os.environ.get("PHYSION_SCREENSHOTS")
        if folder and self.name:
            self._pictures += 1
            Path(folder).mkdir(parents=True, exist_ok=True)
            self.page.screenshot(path=f"{folder}/{self.name}-{self._pictures:02d}-{what}.png")

    def go(self, query: str = "") -> None:
        """Open the study with this query string."""
        self.page.goto(f"{self.url}/{query}")

    def heading(self, wanted: str | None = None) -> str:
        """Wait for a heading (containing ``wanted`` if given) and return its text."""
        locator = self.page.locator("h1", has_text=wanted) if wanted else self.page.locator("h1")
        locator.wait_for()
        return str(locator.inner_text())

    def press(self, *keys: str) -> None:
        for key in keys:
            self.page.keyboard.press(key)

    def main_button(self) -> Any:
        """Return the locator of the button that continues to the next page."""
        return self.page.locator("main .button:not(.quiet):enabled")

    def wait_for_answer(self) -> None:
        """Wait until the buttons of a trial are enabled."""
        self.page.locator(".answer:enabled").first.wait_for()

    def left(self) -> str:
        """Return the response of the left button."""
        return str(self.page.locator(".answer").first.get_attribute("data-response"))

    def answer(self, response: str, by: str = "mouse") -> None:
        """Answer the trial as soon as the buttons are enabled."""
        self.wait_for_answer()
        if by == "keyboard":
            self.press("f" if self.left() == response else "j")
        else:
            self.page.click(f".answer[data-response={response}]")
        # Wait for the next page, so that nothing is pressed on this one again.
        self.page.locator(".answer:enabled").first.wait_for(state="detached")

    def see_feedback(self) -> str:
        """Watch the full movie, continue, and return the verdict on the answer."""
        self.main_button().wait_for()
        verdict = str(self.page.locator(".verdict").inner_text())
        self.main_button().click()
        return verdict

    def begin(self, query: str = "") -> None:
        """Go from the consent page to the first trial."""
        self.go(query)
        self.heading()
        self.main_button().click()
        self.page.locator("#language").wait_for(state="detached")
        for _ in range(3):
            self.heading()
            self.main_button().click()

    def practise(self, trials: int) -> None:
        for trial in range(trials):
            self.answer("yes" if trial % 2 == 0 else "no")
            self.see_feedback()

    def begin_test(self, title: str = "You are ready") -> None:
        self.heading(title)
        self.main_button().click()

    def to_the_test(self, query: str = "") -> None:
        """Go to the first test trial of a study with one practice trial."""
        self.begin(query)
        self.practise(1)
        self.begin_test()
        self.page.locator(".answer").first.wait_for()

    def take_part(self, query: str, *responses: str) -> str:
        """Complete a session with these answers to the test; return the text of the last page."""
        self.to_the_test(query)
        for response in responses:
            self.answer(response)
        self.heading("About you")
        self.finish()
        return str(self.page.inner_text("main"))

    def finish(self) -> None:
        """Fill in demographics and feedback and wait for the completion code."""
        self.send_forms()
        self.page.locator("#code").wait_for()

    def send_forms(self) -> None:
        """Fill in demographics and feedback."""
        self.page.fill("#age", "33")
        self.page.select_option("#gender", "female")
        self.page.select_option("#education", "master")
        self.main_button().click()
        self.page.check("#difficulty-4")
        self.page.check("#technical-no")
        self.page.fill("#text", "<img src=x onerror=alert(1)> 'ok'")
        self.main_button().click()


def rows_of(study: Study, raw_id: str) -> tuple[Any, list[Any], list[Any]]:
    """Return session, ordered answers and events of the person with this ``?participant=`` id."""
    participant = participant_hash(Secrets.load(study.folder), "link", raw_id)
    engine = open_database(study.folder)
    try:
        with engine.connect() as connection:
            session = connection.execute(
                sa.select(SESSIONS).where(SESSIONS.c.participant == participant)
            ).one()
            answers, events = (
                list(connection.execute(sa.select(table).where(of)).all())
                for table, of in (
                    (ANSWERS, ANSWERS.c.session == session.session),
                    (EVENTS, EVENTS.c.session == session.session),
                )
            )
    finally:
        engine.dispose()
    order = {"familiarization": 0, "test": 1, "attention": 1}
    return session, sorted(answers, key=lambda row: (order[row.phase], row.trial)), events
