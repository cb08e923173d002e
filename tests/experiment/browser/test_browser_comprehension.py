"""The comprehension check and the page after too many attempts, in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.study.settings import Comprehension, EarlyEnd
from support.experiment.browser import Visit, chromium, rows_of, served
from support.experiment.own_questions import COMPREHENSION, COMPREHENSION_TEXTS

__all__ = ["chromium"]
pytestmark = pytest.mark.slow
CHECKS = {
    "comprehension_questions": COMPREHENSION,
    "more_texts": COMPREHENSION_TEXTS,
    "comprehension": Comprehension(attempts=2),
    "screened_out": EarlyEnd("", "OUT-CODE", "https://lab.example/out"),
}


def attempt(visit: Visit, colour: str) -> None:
    visit.heading("Before you begin")
    visit.page.get_by_label("What touches").check()
    visit.page.get_by_label(colour).check()
    visit.main_button().click()


def test_wrong_answers_lead_back_to_the_instructions_and_then_to_the_end(
    chromium: Any, tmp_path: Path
) -> None:
    with (
        served(tmp_path, test=1, familiarization=1, **CHECKS) as (study, server),
        Visit(chromium, server.url, "comprehension") as visit,
    ):
        visit.begin("?participant=Ada&language=en")
        visit.heading("Before you begin")
        visit.main_button().click()
        assert visit.page.get_by_text("Please answer this question.").count() == 2
        visit.picture("missing")
        attempt(visit, "The green one")
        visit.heading("What you will do")
        visit.page.get_by_text("Attempts left: 1").wait_for()
        visit.picture("again")
        for _ in range(3):
            visit.main_button().click()
        attempt(visit, "The yellow one")
        visit.heading("The study ends here for you")
        visit.picture("ended")
        assert visit.page.inner_text("#code") == "OUT-CODE"
        assert visit.page.get_attribute("#go", "href") == "https://lab.example/out"
        assert visit.page.get_by_text("Stop taking part").count() == 0
        visit.go("?participant=Ada&language=en")
        visit.heading("The study ends here for you")
        assert visit.unexpected() == []
    session, answers, _ = rows_of(study, "Ada")
    assert (session.comprehension_attempts, session.screened_out_by) == (2, "comprehension")
    assert answers == []
