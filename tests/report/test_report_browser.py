"""The report in a real browser, wide and narrow, light and dark."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from physion.analysis.comparison import Comparison
from physion.report.build import build_report
from physion.report.inputs import ReportInputs
from physion.trials.video import encode_movie
from support.browser import Browser

pytestmark = pytest.mark.slow
Maker = Callable[..., Comparison]
SIZES = ((1280, 900), (400, 900))
CUT = """[...document.querySelectorAll("main *:not(.wide)")].filter(one =>
  !one.closest("details:not([open])") && (
    (one.getBoundingClientRect().right > innerWidth + 1 && !one.closest(".wide")) ||
    (one.scrollWidth > one.clientWidth + 1 && getComputedStyle(one).overflowX !== "visible")
  )).map(one => one.outerHTML.slice(0, 80))"""
"""Script for the elements of a page that are cut."""
MODEL = "a model with a name that is far too long for one line of a card of the page"


@pytest.fixture(scope="module")
def page(make_comparison: Maker, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A report whose movies become brighter from picture to picture."""
    grey = np.arange(60, dtype=np.uint8)[:, None, None, None]
    folder = tmp_path_factory.mktemp("report")
    movie = folder / "movie.mp4"
    movie.write_bytes(encode_movie(np.broadcast_to(40 + 3 * grey, (60, 64, 64, 3)).copy()))
    comparison = make_comparison(model=MODEL)
    movies = dict.fromkeys(comparison.stimuli["stimulus"], movie)
    inputs = ReportInputs(comparison, movies=movies)
    return build_report(inputs, folder / "report")


def test_movies_in_view_play_and_nothing_else_is_asked_for(browser: Browser, page: Path) -> None:
    browser.open(page)
    browser.ask("document.querySelector('#one-trial-of-each-scenario').scrollIntoView()")
    seen = "[...document.querySelectorAll('#one-trial-of-each-scenario video')]"
    browser.until(f"{seen}.length === 2 && {seen}.every(v => v.currentTime > 0.1 && v.muted)")
    far = "[...document.querySelectorAll('#what-people-and-models-disagree-on video')]"
    assert browser.ask(f"{far}.length") == 8
    assert browser.ask(f"{far}.every(v => v.paused && v.currentTime === 0)"), "not yet in view"
    assert browser.complaints() == []
    assert browser.requests() == [page.resolve().as_uri()]


def test_with_reduced_motion_a_movie_plays_only_on_request(browser: Browser, page: Path) -> None:
    browser.open(page, reduced_motion=True)
    first = "document.querySelector('#one-trial-of-each-scenario .movie')"
    assert browser.ask(f"{first}.querySelector('img').getBoundingClientRect().width > 100")
    browser.ask("new Promise(done => setTimeout(done, 1500))")
    movies = "[...document.querySelectorAll('video')]"
    assert browser.ask(f"{movies}.length") == 10
    assert browser.ask(f"{movies}.every(v => v.paused && v.currentTime === 0)")
    browser.ask(f"{first}.scrollIntoView()")
    browser.ask(f"{first}.querySelector('input').click()")
    browser.until(f"{first}.querySelector('video').currentTime > 0.1")
    assert browser.ask(f"getComputedStyle({first}.querySelector('img')).display") == "none"
    others = f"{movies}.filter(v => v !== {first}.querySelector('video'))"
    assert browser.ask(f"{others}.every(v => v.currentTime === 0)")
    browser.open(page)
    assert browser.ask(f"getComputedStyle({first}.querySelector('label')).display") == "none"


@pytest.mark.nightly
def test_the_page_is_not_wider_than_the_screen(browser: Browser, page: Path) -> None:
    for size in SIZES:
        for dark in (False, True):
            browser.open(page, size=size, dark=dark)
            assert browser.ask("document.documentElement.scrollWidth") <= size[0]
            assert browser.ask(CUT) == [], "only tables may be wider, in boxes that scroll"
            assert (browser.picture()[5, 5].mean() < 128) == dark
            assert browser.complaints() == []


def test_bars_have_the_length_of_the_answers(browser: Browser, page: Path) -> None:
    browser.open(page)
    lengths = browser.ask(
        "[...document.querySelectorAll('#one-trial-of-each-scenario .human')].map(item => ["
        "parseFloat(item.querySelector('b').textContent) / 100,"
        "item.querySelector('s').getBoundingClientRect().width"
        " / item.querySelector('i').getBoundingClientRect().width])"
    )
    assert len(lengths) == 2
    assert all(length == pytest.approx(said, abs=0.01) for said, length in lengths)
