"""A whole session in Firefox on a real server."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from support.experiment.browser import Visit, firefox, rows_of, served

__all__ = ["firefox"]
pytestmark = pytest.mark.slow


def test_a_whole_session_in_firefox(firefox: Any, tmp_path: Path) -> None:
    with served(tmp_path) as (study, server), Visit(firefox, server.url, "firefox") as visit:
        visit.begin("?participant=Fox")
        told = []
        for _ in range(2):
            visit.answer("yes")
            told.append(visit.see_feedback())
        # Labels of the tiny study alternate, the first with contact.
        assert told == ["Correct!", "Not correct."]
        visit.begin_test()
        for trial, (response, by) in enumerate(
            (("yes", "mouse"), ("no", "keyboard"), ("yes", "mouse"))
        ):
            visit.page.get_by_text(f"Trial {trial + 1} of 3").wait_for()
            visit.answer(response, by=by)
        visit.heading("About you")
        visit.finish()
        assert visit.page.inner_text("#code") == "TINY-CODE"
        assert visit.unexpected() == []
        assert visit.hosts() == {server.url.removeprefix("http://")}
    session, answers, _ = rows_of(study, "Fox")
    assert session.finished_at is not None and "Firefox/" in session.device["user_agent"]
    assert (session.age, session.feedback) == (33, "<img src=x onerror=alert(1)> 'ok'")
    assert [row.response for row in answers] == ["yes", "yes", "yes", "no", "yes"]
    assert [row.input for row in answers] == ["mouse", "mouse", "mouse", "keyboard", "mouse"]
    for row in answers:
        # Firefox tells which frames it presented, as Chromium does; a busy machine drops some.
        assert row.frames_shown is not None and 0 < row.frames_shown <= row.frames_expected
        assert row.cue_ms > 400 and row.rt_ms > 0 and row.showings == 1
