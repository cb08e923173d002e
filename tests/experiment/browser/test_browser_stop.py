"""The question whether to stop, and trials that are shown twice, in a real browser."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.study.study import Study
from support.experiment.browser import Visit, chromium, rows_of, served, signed_query

__all__ = ["chromium"]
pytestmark = pytest.mark.slow
COUNT_PLAYS = """
window.plays = 0;
const original = HTMLVideoElement.prototype.play;
HTMLVideoElement.prototype.play = function () { window.plays += 1; return original.call(this); };
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, str]]:
    with served(tmp_path_factory.mktemp("study"), test=2, familiarization=1) as (study, server):
        yield study, server.url


def to_the_test(visit: Visit, name: str) -> None:
    visit.begin(f"?participant={name}")
    visit.practise(1)
    visit.begin_test()


def test_the_trial_continues_behind_the_question(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url, "question") as visit:
        visit.context.add_init_script(COUNT_PLAYS)
        to_the_test(visit, "Question")
        visit.wait_for_answer()
        plays = visit.page.evaluate("plays")
        for close in ("button", "Escape"):
            visit.page.get_by_text("Stop taking part").click()
            visit.heading("Do you want to stop?")
            visit.page.wait_for_timeout(400)
            visit.picture("asked")
            # Keys are not answers while the question is open.
            visit.press("f", "j")
            if close == "Escape":
                visit.press("Escape")
            else:
                visit.page.get_by_text("Go on with the study").click()
            visit.page.locator("dialog").wait_for(state="detached")
            assert visit.page.locator(".answer:enabled").count() == 2
        visit.answer("no", by="keyboard")
        assert visit.page.evaluate("plays") == plays
        visit.answer("yes")
        visit.heading("About you")
        visit.page.wait_for_timeout(100)
        visit.page.reload()  # sends the events
        visit.heading("About you")
        assert visit.unexpected() == []
    _, answers, events = rows_of(study, "Question")
    asked, other = (row for row in answers if row.phase == "test")
    assert (asked.response, asked.resumed, asked.input) == ("no", False, "keyboard")
    details = json.loads(asked.details)
    assert (details["attempts"], details["stop_asked"]) == (1, 2)
    assert asked.rt_ms > 800
    assert json.loads(other.details)["stop_asked"] == 0
    noted = [(event.kind, event.data) for event in events if event.kind.startswith("stop_")]
    place = {"stage": "test", "phase": "test", "trial": 0}
    assert noted == [("stop_asked", place), ("stop_answered", {**place, "stop": False})] * 2


def test_stopping_sends_what_was_answered(chromium: Any, site: tuple[Study, str]) -> None:
    study, url = site
    with Visit(chromium, url) as visit:
        to_the_test(visit, "Leaving")
        visit.wait_for_answer()
        visit.context.set_offline(True)
        visit.answer("no")
        visit.page.get_by_text("Trial 2 of 2").wait_for()
        visit.page.get_by_text("Stop taking part").click()
        visit.page.get_by_text("Stop for good").click()
        visit.heading("One moment")
        visit.context.set_offline(False)
        visit.heading("You have stopped")
        assert visit.unexpected() == []
    session, answers, events = rows_of(study, "Leaving")
    assert session.withdrawn_at is not None
    assert [row.response for row in answers if row.phase == "test"] == ["no"]
    (stopped,) = [event.data for event in events if event.kind == "stop_answered"]
    assert stopped == {"stage": "test", "phase": "test", "trial": 1, "stop": True}


def test_a_trial_that_is_shown_twice_says_so(chromium: Any, site: tuple[Study, str]) -> None:
    """Another device answered the previous trial: the page learns it during the next one."""
    study, url = site
    with Visit(chromium, url) as visit, Visit(chromium, url) as there:
        to_the_test(visit, "Twice")
        there.go(signed_query(study, "Twice"))
        there.answer("yes")
        there.page.get_by_text("Trial 2 of 2").wait_for()
        there.page.close()
        held: list[Any] = []

        def hold_the_first(route: Any) -> None:
            if held:
                route.continue_()
            else:
                held.append(route)

        visit.context.route("**/api/answers", hold_the_first)
        visit.answer("no")
        visit.page.get_by_text("Trial 2 of 2").wait_for()
        visit.wait_for_answer()  # the movie of the second trial is over
        held[0].continue_()
        visit.page.locator(".answer:enabled").first.wait_for(state="detached")
        visit.answer("no")
        visit.heading("About you")
        assert visit.unexpected() == []
    answers = [row for row in rows_of(study, "Twice")[1] if row.phase == "test"]
    assert [(row.response, row.resumed) for row in answers] == [("yes", True), ("no", True)]
    assert json.loads(answers[1].details)["attempts"] == 2
