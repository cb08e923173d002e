"""Breaks between test trials, in a real browser."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

import sqlalchemy as sa

from physion.experiment.server_process import ServerProcess
from physion.experiment.store.database import ANSWERS, open_database
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.study import STUDY_FILE, Study
from support.experiment.browser import FAST, SHORT, Visit, chromium, rows_of, served
from support.experiment.tiny_study import make_tiny_study

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


def test_the_break_comes_after_25_trials_unless_the_study_says_otherwise(
    chromium: Any, tmp_path: Path
) -> None:
    """A preview jumps to the trials before it, and to the last ones."""
    study = make_tiny_study(tmp_path, test=50, familiarization=1, timing=SHORT, plausibility=FAST)
    settings = study.folder / STUDY_FILE
    kept = [line for line in settings.read_text().splitlines() if "break_every" not in line]
    settings.write_text("\n".join(kept) + "\n")
    word = make_pass(Secrets.load(study.folder), "preview")
    with (
        ServerProcess(study.folder) as server,
        Visit(chromium, server.url, "default-break") as visit,
    ):
        page = visit.page

        def jump(trial: int) -> None:
            page.select_option("#jump-stage", "test")
            page.fill("#jump-trial", str(trial))
            page.get_by_role("button", name="Go there").click()
            page.get_by_text(f"Trial {trial} of 50").wait_for()

        visit.go(f"?pass={word}&language=en")
        visit.heading("Taking part in this study")
        jump(24)
        visit.answer("yes")
        page.get_by_text("Trial 25 of 50").wait_for()  # no break yet
        visit.answer("yes")
        visit.heading("Time for a break")
        assert "You have answered 25 of 50 movies" in page.inner_text("main")
        page.wait_for_timeout(700)
        page.get_by_role("button", name="Go on").click()
        visit.answer("no")
        page.get_by_text("Trial 27 of 50").wait_for()
        stored = {row.trial: row.break_ms for row in preview_answers(study)}
        jump(49)
        visit.answer("yes")
        page.get_by_text("Trial 50 of 50").wait_for()
        visit.answer("yes")
        visit.heading("About you")  # no break after the last trial
        assert visit.unexpected() == []
    stored |= {row.trial: row.break_ms for row in preview_answers(study)}
    rested = stored.pop(25)
    assert rested >= 700 and stored == dict.fromkeys((23, 24, 48, 49))


def preview_answers(study: Study) -> list[Any]:
    """Return the answers to test trials of the only session."""
    engine = open_database(study.folder)
    try:
        with engine.connect() as connection:
            return list(connection.execute(sa.select(ANSWERS).where(ANSWERS.c.phase == "test")))
    finally:
        engine.dispose()
