"""Trials that are interrupted, hidden, too large for the window, or whose movie fails."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from physion.experiment.study.study import Study
from support.experiment.browser import (
    FAST,
    HIDE,
    SHORT,
    SIZE,
    Visit,
    answers_to_test,
    rows_of,
    served,
)

pytestmark = pytest.mark.slow
SMALL = {"width": 900, "height": 560}
HIDE_AT = f"""
const hide = {HIDE};
window.hideAt = [];
let last = null;
new MutationObserver(() => {{
  const place = window.hideAt.length > 0 ? document.querySelector(window.hideAt[0]) : null;
  if (!place || place === last || document.hidden) return;
  last = place;
  window.hideAt.shift();
  hide(true);
  setTimeout(hide, 300, false);
}}).observe(document, {{ subtree: true, childList: true, attributes: true }});"""
"""Script that hides the page for a moment as soon as the first element of `hideAt` appears."""


@pytest.fixture(scope="module", params=[pytest.param("repeat", marks=pytest.mark.nightly), "void"])
def slow(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Study, str]]:
    """A study whose cue leaves time to interrupt a showing, under either rule."""
    rules = replace(FAST, interrupted=request.param)
    folder, timing = tmp_path_factory.mktemp("study"), replace(SHORT, cue_ms=3000)
    with served(folder, plausibility=rules, timing=timing) as (study, server):
        yield study, server.url


def test_a_question_or_a_small_window_interrupts_a_trial(
    chromium: Any, slow: tuple[Study, str]
) -> None:
    """It is shown again, and showings are counted; or it continues and its answer is void."""
    study, url = slow
    repeats = study.plausibility.interrupted == "repeat"
    # As on a laptop with scaling or zoom: everything but the trials is possible.
    with Visit(chromium, url, "interrupted", viewport=SMALL, screen=SMALL) as visit:
        visit.begin("?participant=Ada&language=en")
        visit.heading("Please make the window larger")
        visit.picture("small")
        visit.page.set_viewport_size(SIZE)
        visit.practise(1)
        visit.begin_test()
        visit.page.locator(".screen").wait_for()
        visit.page.click("#tools button")  # the question whether to stop
        visit.page.locator("dialog[open]").wait_for()
        visit.press("Escape")
        visit.wait_for_answer()
        if repeats:
            visit.page.reload()  # at the buttons: the movie is shown once more
        visit.answer("yes")
        visit.page.locator(".screen").wait_for()
        visit.page.set_viewport_size(SMALL)
        if repeats:
            visit.heading("Please make the window larger")
        else:
            visit.wait_for_answer()
        visit.page.set_viewport_size(SIZE)
        visit.answer("no")
        visit.answer("no")
        visit.finish()
        assert visit.unexpected() == []
    session, _, events = rows_of(study, "Ada")
    test = answers_to_test(study, "Ada")
    assert [row.showings for row in test] == ([3, 2, 1] if repeats else [1, 1, 1])
    assert [row.void for row in test] == ([None] * 3 if repeats else ["dialog", "window", None])
    assert [row.frames_shown > 0 for row in test] == [True] * 3
    assert (test[2].window_width, test[2].window_height) == (1280, 800)
    assert (session.replayed, session.implausible, session.unfetched) == (int(repeats), None, 0)
    assert "too_small" in {event.kind for event in events}
    reasons = [row.data["reason"] for row in events if row.kind == "trial_interrupted"]
    assert reasons == (["dialog", "window"] if repeats else [])


def test_a_trial_that_was_hidden_is_shown_again(chromium: Any, site: tuple[Study, str]) -> None:
    """It restarts at the fixation cross, unless the page was hidden after the movie."""
    study, url = site
    with Visit(chromium, url) as visit:
        visit.context.add_init_script(HIDE_AT)
        visit.begin("?participant=Again")
        # In the practice, the page is hidden after the movie only.
        visit.wait_for_answer()
        visit.page.evaluate(HIDE, True)
        visit.page.wait_for_timeout(200)
        visit.page.evaluate(HIDE, False)
        visit.practise(1)
        visit.heading("You are ready")
        # The cross lasts too short a time to find it from here; then the cue.
        visit.page.evaluate("window.hideAt = ['.fixation', '.screen-cover[hidden]']")
        visit.begin_test()
        visit.wait_for_answer()
        visit.page.evaluate(HIDE, True)
        visit.page.evaluate(HIDE, False)
        visit.page.evaluate("window.hideAt = Array(6).fill('.fixation')")
        visit.answer("yes")
        visit.answer("no")  # the last time the trial continued
        assert visit.page.evaluate("window.hideAt") == []
        visit.answer("no")
        visit.heading("About you")
        assert visit.unexpected() == []
    _, answers, events = rows_of(study, "Again")
    details = [json.loads(row.details) for row in answers]
    assert [(one["attempts"], one["hidden"]) for one in details[1:]] == [(3, 2), (6, 6), (1, 0)]
    assert [row.visibility_changes for row in answers] == [2, 6, 12, 0]
    assert [state for _, state in details[0]["visibility"]] == ["hidden", "visible"]
    assert [row.void for row in answers] == [None, None, "hidden", None]
    assert {"hidden", "visible"} <= {event.kind for event in events}
    for row, one in zip(answers, details, strict=True):
        assert row.cue_ms >= 440
        assert [on for _, on in one["flashes"]] == [True, False]
        assert row.frames_shown > 0


def test_movies_that_fail_are_shown_again(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url, "movie") as visit:
        asked: list[str] = []

        def spoil(route: Any) -> None:
            asked.append(route.request.url)
            times = asked.count(route.request.url)
            if "/t-0-movie-" in route.request.url and times == 1:
                route.fulfill(body=b"no movie", content_type="video/mp4")
            elif "/t-1-map-" in route.request.url and times <= 2:
                refusal = {"error": "not_found", "message": "no such movie or picture"}
                route.fulfill(status=404, json=refusal)
            else:
                route.continue_()

        visit.context.route("**/media/*", spoil)
        visit.begin("?participant=Movie")
        visit.practise(1)
        visit.begin_test()
        visit.page.get_by_text("The movies could not be loaded.").wait_for()
        visit.picture("not-loaded")
        visit.main_button().click()
        visit.page.get_by_text("The movie could not be played.").wait_for()
        visit.picture("not-played")
        for response in ("yes", "no", "no"):
            visit.answer(response)
        visit.heading("About you")
        visit.finish()
    _, answers, events = rows_of(study, "Movie")
    assert [json.loads(row.details)["attempts"] for row in answers] == [1, 2, 1, 1]
    assert [row.response for row in answers[1:]] == ["yes", "no", "no"]
    assert "movie_failed" in {event.kind for event in events}
