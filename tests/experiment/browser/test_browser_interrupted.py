"""Trials that are interrupted or repeated, in a real browser."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from support.experiment.browser import FAST, HIDE, SHORT, SIZE, Visit, chromium, rows_of, served

__all__ = ["chromium"]
SMALL = {"width": 700, "height": 400}
SLOW: dict[str, Any] = {"familiarization": 1, "timing": replace(SHORT, cue_ms=4000)}
"""Settings that leave time to interrupt a showing."""
HIDE_MOVIES = f"""
const hide = {HIDE};
document.addEventListener("playing", () => {{
  if (!window.hideMovies) return;
  hide(true);
  setTimeout(hide, 50, false);
}}, true);"""
"""Script that hides the page for a moment whenever a movie starts, if `hideMovies` is set."""


def to_the_test(visit: Visit, query: str) -> None:
    visit.begin(query)
    visit.practise(1)
    visit.begin_test()


@pytest.mark.slow
def test_interrupted_trials_are_shown_again_and_showings_are_counted(
    chromium: Any, tmp_path: Path
) -> None:
    with (
        served(tmp_path / "s", plausibility=FAST, **SLOW) as (study, server),
        Visit(chromium, server.url, "interrupted") as visit,
    ):
        to_the_test(visit, "?participant=Ada&language=en")
        visit.page.locator(".screen").wait_for()
        visit.page.click("#tools button")  # the question whether to stop
        visit.page.locator("dialog[open]").wait_for()
        visit.press("Escape")
        visit.wait_for_answer()
        visit.page.reload()  # at the buttons: the movie is shown once more
        visit.answer("yes")
        visit.page.locator(".screen").wait_for()
        visit.page.set_viewport_size(SMALL)
        visit.heading("Please make the window larger")
        visit.page.set_viewport_size(SIZE)
        visit.answer("no")
        visit.answer("no")
        visit.finish()
        session, answers, events = rows_of(study, "Ada")
    test = [row for row in answers if row.phase == "test"]
    assert [row.showings for row in test] == [3, 2, 1]
    assert [row.void for row in test] == [None] * 3
    assert (session.replayed, session.implausible, session.unfetched) == (1, None, 0)
    reasons = [row.data["reason"] for row in events if row.kind == "trial_interrupted"]
    assert reasons == ["dialog", "window"]


@pytest.mark.slow
def test_interrupted_trials_go_on_and_are_void(chromium: Any, tmp_path: Path) -> None:
    """The movie plays once, and its answer says what interrupted it; later trials count again."""
    rules = replace(FAST, interrupted="void")
    with (
        served(tmp_path / "s", test=3, plausibility=rules, **SLOW) as (study, server),
        Visit(chromium, server.url, "void") as visit,
    ):
        to_the_test(visit, "?participant=Bo&language=en")
        visit.page.locator(".screen").wait_for()
        visit.page.click("#tools button")  # the question whether to stop
        visit.page.locator("dialog[open]").wait_for()
        visit.press("Escape")
        visit.answer("yes")
        visit.page.locator(".screen").wait_for()
        visit.page.set_viewport_size(SMALL)
        visit.wait_for_answer()
        visit.page.set_viewport_size(SIZE)
        visit.answer("no")
        visit.answer("no")
        visit.finish()
        assert visit.unexpected() == []
    session, answers, events = rows_of(study, "Bo")
    test = [row for row in answers if row.phase == "test"]
    assert [row.void for row in test] == ["dialog", "window", None]
    assert [row.showings for row in test] == [1, 1, 1]
    assert [row.frames_shown > 0 for row in test] == [True] * 3
    assert (session.replayed, session.implausible) == (0, None)
    assert not [row for row in events if row.kind == "trial_interrupted"]


@pytest.mark.slow
@pytest.mark.parametrize(("interrupted", "showings"), [("void", 1), ("repeat", 6)])
def test_a_trial_whose_movie_is_hidden_each_time_is_void(
    chromium: Any, tmp_path: Path, interrupted: str, showings: int
) -> None:
    """At once, or after five repetitions; later trials count again."""
    rules = replace(FAST, interrupted=interrupted)
    with (
        served(tmp_path / "s", familiarization=1, test=2, plausibility=rules) as (study, server),
        Visit(chromium, server.url, f"hidden-{interrupted}") as visit,
    ):
        visit.context.add_init_script(HIDE_MOVIES)
        visit.begin("?participant=Cy&language=en")
        visit.practise(1)
        visit.page.evaluate("window.hideMovies = true")
        visit.begin_test()
        visit.wait_for_answer()
        visit.page.evaluate("window.hideMovies = false")
        visit.answer("yes")
        visit.answer("no")
        visit.finish()
        assert visit.unexpected() == []
    session, answers, events = rows_of(study, "Cy")
    test = [row for row in answers if row.phase == "test"]
    assert [row.void for row in test] == ["hidden", None]
    assert [row.showings for row in test] == [showings, 1]
    details = [json.loads(row.details) for row in test]
    assert [(one["attempts"], one["hidden"]) for one in details] == [(showings, showings), (1, 0)]
    assert test[0].visibility_changes >= 2 * showings and test[1].visibility_changes == 0
    assert [row.frames_shown > 0 for row in test] == [True, True]
    # More showings than `max_showings` flag the session.
    assert (session.replayed, session.implausible) == (int(showings > 2), None)
    told = [row.data for row in events if row.kind == "trial_interrupted"]
    again = [{"trial": 0, "attempt": i + 1, "reason": "hidden"} for i in range(showings - 1)]
    assert told == again
