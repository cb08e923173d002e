"""Full screen during the trials, in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.study.settings import Screen
from support.experiment.browser import Visit, chromium, rows_of, served

__all__ = ["chromium"]
pytestmark = pytest.mark.slow


def test_full_screen_is_offered_until_it_is_declined(chromium: Any, tmp_path: Path) -> None:
    screen = Screen(fullscreen=True)
    with (
        served(tmp_path, test=2, familiarization=1, screen=screen) as (study, server),
        Visit(chromium, server.url, "fullscreen") as visit,
    ):
        is_full = "document.fullscreenElement !== null"
        visit.begin("?participant=Full")
        visit.heading("Full screen")
        visit.picture("offer")
        visit.page.get_by_role("button", name="Switch to full screen").click()
        visit.practise(1)
        assert visit.page.evaluate(is_full)
        visit.begin_test()
        visit.answer("yes")
        visit.page.evaluate("document.exitFullscreen()")
        visit.answer("no")  # the trial continues
        visit.heading("About you")
        assert not visit.page.evaluate(is_full)
        visit.page.reload()  # sends the events
        visit.heading("About you")
        visit.begin("?participant=Plain")
        visit.heading("Full screen")
        visit.page.get_by_role("button", name="Go on without").click()
        visit.practise(1)
        visit.begin_test()
        visit.answer("yes")  # it is not offered again
        visit.answer("no")
        visit.heading("About you")
        visit.page.reload()
        visit.heading("About you")
        assert visit.unexpected() == []
    events = [(event.kind, event.data) for event in rows_of(study, "Full")[2]]
    assert ("fullscreen", {"on": True}) in events and ("fullscreen", {"on": False}) in events
    events = [(event.kind, event.data) for event in rows_of(study, "Plain")[2]]
    assert ("no_fullscreen", {"reason": "declined"}) in events
