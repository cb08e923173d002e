"""Breaks between test trials, in a real browser."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")


from support.experiment.browser import SHORT, Visit, chromium, rows_of, served

__all__ = ["chromium"]
pytestmark = pytest.mark.slow


def test_breaks_are_offered_and_stored(chromium: Any, tmp_path: Path) -> None:
    timing = replace(SHORT, break_every=2)
    with (
        served(tmp_path, test=4, familiarization=1, timing=timing) as (study, server),
        Visit(chromium, server.url, "break") as visit,
    ):
        visit.begin("?participant=Rest")
        visit.practise(1)
        visit.heading("You are ready")
        said = visit.page.inner_text("main")
        assert "After every 2 movies you can take a break" in said
        assert "you may rest before you answer" not in said
        visit.begin_test()
        visit.answer("yes")
        visit.answer("no")
        for _ in range(2):  # a reload shows the break again
            visit.heading("Time for a break")
            assert "You have answered 2 of 4 movies" in visit.page.inner_text("main")
            visit.picture("break")
            visit.page.reload()
        visit.heading("Time for a break")
        visit.page.wait_for_timeout(700)
        visit.page.get_by_role("button", name="Go on").click()
        visit.answer("yes")
        visit.answer("no")
        visit.heading("About you")  # no break after the last trial
        visit.page.reload()  # sends the events
        visit.heading("About you")
        assert visit.unexpected() == []
    _, answers, events = rows_of(study, "Rest")
    rests = [row.break_ms for row in answers if row.phase == "test"]
    assert rests[:2] == [None, None] and rests[3] is None
    assert 700 <= rests[2] < 60_000
    assert answers[3].rt_ms < 60_000
    assert [event.data for event in events if event.kind == "break"] == [{"trial": 2}] * 3
