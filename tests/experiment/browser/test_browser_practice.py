"""A practice with too few right answers is repeated, in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.study.settings import EarlyEnd, Practice
from support.experiment.browser import Visit, chromium, rows_of, served

__all__ = ["chromium"]
pytestmark = pytest.mark.slow


def test_the_practice_is_repeated_and_then_ends(chromium: Any, tmp_path: Path) -> None:
    rules = {"practice": Practice(min_correct=1), "screened_out": EarlyEnd(code="OUT-CODE")}
    with (
        served(tmp_path, test=1, familiarization=1, **rules) as (study, server),
        Visit(chromium, server.url, "practice") as visit,
    ):
        visit.begin("?participant=Ada&language=en")
        visit.answer("no")
        assert visit.see_feedback() == "Not correct."
        visit.heading("The practice once more")
        visit.picture("again")
        visit.page.reload()
        visit.heading("The practice once more")
        visit.main_button().click()
        visit.page.get_by_text("Practice 1 of 1").wait_for()
        visit.answer("no")
        visit.see_feedback()
        visit.heading("The study ends here for you")
        assert visit.page.inner_text("#code") == "OUT-CODE"
        assert visit.unexpected() == []
    session, answers, _ = rows_of(study, "Ada")
    assert (session.screened_out_by, session.practice_repeats) == ("practice", 1)
    assert [(row.showings, row.resumed) for row in answers] == [(1, True)]
    assert session.implausible is None
