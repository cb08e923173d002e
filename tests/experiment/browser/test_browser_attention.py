"""An instructed attention check, in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.study.settings import Attention
from support.experiment.browser import Visit, chromium, rows_of, served

__all__ = ["chromium"]
pytestmark = pytest.mark.slow


def test_the_page_says_what_to_press_after_the_movie(chromium: Any, tmp_path: Path) -> None:
    checks = {"attention": Attention(instructed=1)}
    with (
        served(tmp_path, test=1, familiarization=1, **checks) as (study, server),
        Visit(chromium, server.url, "attention") as visit,
    ):
        visit.begin("?participant=Ada&language=en")
        visit.practise(1)
        visit.begin_test()
        visit.answer("yes")
        visit.page.get_by_text("Trial 2 of 2").wait_for()
        assert visit.page.inner_text("#prompt").startswith("Will the red object")
        visit.wait_for_answer()
        asked = visit.page.inner_text("#prompt")
        visit.picture("check")
        wrong = "no" if "YES" in asked else "yes"
        assert asked.startswith("A check of your attention")
        visit.answer(wrong)
        visit.finish()
        assert "of 1 movies" in visit.page.inner_text("main")
        assert visit.unexpected() == []
    session, _, _ = rows_of(study, "Ada")
    assert (session.attention_failed, session.failed_checks) == (1, "attention")
    assert session.implausible is None
