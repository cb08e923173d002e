"""The experimenter's pages in a real browser."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from physion.experiment.server_process import ServerProcess
from physion.experiment.store.database import open_database
from physion.experiment.study.identity import Secrets
from physion.experiment.study.study import Study
from support.experiment.experimenter_client import BASE, TWO
from support.experiment.experimenter_rows import insert_sessions
from support.experiment.tiny_study import PASSWORD, make_tiny_study

pytestmark = pytest.mark.slow
PAGES = ("", "?kind=simulated", "/sessions", "/sessions?flag=any", "/export", "/payments")


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, str]]:
    study = make_tiny_study(tmp_path_factory.mktemp("study"), test=20, scenarios=TWO, size=64)
    with ServerProcess(study.folder) as server:
        add(study, 120)
        yield study, server.url + BASE


def add(study: Study, count: int, **settings: Any) -> list[str]:
    engine = open_database(study.folder)
    try:
        return insert_sessions(engine, study, Secrets.load(study.folder), count, **settings)
    finally:
        engine.dispose()


def new_context(chromium: Any, **settings: Any) -> Any:
    """Open a window in which each step may take as long as on a slow machine."""
    context = chromium.new_context(**settings)
    context.set_default_timeout(120_000)
    return context


def log_in(page: Any, url: str, password: str = PASSWORD) -> None:
    page.goto(url)
    page.fill("#password", password)
    page.keyboard.press("Enter")


def picture(page: Any, name: str) -> None:
    """Write a screenshot to $PHYSION_SCREENSHOTS, if it is set."""
    folder = os.environ.get("PHYSION_SCREENSHOTS")
    if folder:
        page.screenshot(path=Path(folder) / f"experimenter-{name}.png", full_page=True)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_all_pages_are_whole(chromium: Any, site: tuple[Study, str], scheme: str) -> None:
    study, url = site
    (name, *_) = add(study, 1, seed=len(scheme), ends=("finished",))
    context = new_context(chromium, color_scheme=scheme, viewport={"width": 1024, "height": 600})
    page = context.new_page()
    complaints: list[str] = []
    page.on("console", lambda message: complaints.append(message.text))
    page.on("pageerror", lambda error: complaints.append(str(error)))
    page.on("requestfailed", lambda request: complaints.append(f"{request.url} {request.failure}"))
    log_in(page, url)
    page.wait_for_selector("text=Log out")
    for place in (*PAGES, f"/sessions/{name}"):
        page.goto(url + place)
        assert page.evaluate("document.documentElement.scrollWidth") <= 1024, place
        cut = page.evaluate(
            "[...document.querySelectorAll('.wide')].filter(e => e.scrollWidth > e.clientWidth)"
            ".map(e => e.innerText.slice(0, 80))"
        )
        assert cut == [], f"{place}: a table is wider than the window"
        picture(page, f"{scheme}-{place.strip('/?').replace('/', '-')[:20] or 'progress'}")
    # The icon of a page that is left at once is given up.
    assert [words for words in complaints if "ERR_ABORTED" not in words] == []
    paper = page.evaluate("getComputedStyle(document.body).backgroundColor")
    assert paper == {"light": "rgb(255, 255, 255)", "dark": "rgb(21, 24, 29)"}[scheme]
    context.close()


def press_enter_on(page: Any, button: str) -> None:
    """Press Enter on a button without waiting for a new page: a download does not open one."""
    page.get_by_role("button", name=button).focus()
    page.keyboard.press("Enter")


def test_from_login_to_logout_by_keyboard(chromium: Any, site: tuple[Study, str]) -> None:
    _, url = site
    context = new_context(chromium)
    page = context.new_page()
    log_in(page, url, "wrong")
    assert "not the password" in page.locator("[role=alert]").inner_text()
    # The new page takes the focus at its first rendering, after which keys are not lost.
    page.locator("#password:focus").wait_for()
    page.keyboard.type(PASSWORD)
    page.keyboard.press("Enter")
    page.wait_for_selector("text=Log out")
    (cookie,) = context.cookies()
    assert cookie["httpOnly"] and cookie["sameSite"] == "Strict" and cookie["path"] == BASE
    assert page.evaluate("document.cookie") == ""
    page.goto(f"{url}/export")
    with page.expect_download() as download:
        press_enter_on(page, "Download")
    assert download.value.suggested_filename.endswith(".zip")
    press_enter_on(page, "Log out")
    page.wait_for_selector("#password")
    page.goto(f"{url}/sessions")
    assert page.url == f"{url}/login"
    context.close()
