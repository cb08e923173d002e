"""The page with the lab's own questions, in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.study.settings import Question
from support.experiment.browser import Visit, chromium, rows_of, served
from support.experiment.own_questions import OWN_ANSWERS, OWN_QUESTIONS, OWN_TEXTS

__all__ = ["chromium"]
pytestmark = pytest.mark.slow
FUN = """
[question.fun]
text = "Was it fun?"
low = "No"
high = "Yes"
"""


def test_own_questions_are_asked_and_stored(chromium: Any, tmp_path: Path) -> None:
    asked = {
        "questions": (*OWN_QUESTIONS, Question("fun", "scale", steps=5)),
        "more_texts": OWN_TEXTS + FUN,
        "demographics": False,
    }
    with (
        served(tmp_path, test=1, familiarization=1, **asked) as (study, server),
        Visit(chromium, server.url, "questions") as visit,
    ):
        page = visit.page
        visit.begin("?participant=Ada&language=en")
        visit.practise(1)
        visit.begin_test()
        visit.answer("yes")
        visit.heading("Some more questions")
        visit.picture("empty")
        visit.main_button().click()
        assert page.get_by_text("Please answer this question.").count() == 2
        assert page.evaluate("document.activeElement.name") == "q-games"
        visit.picture("missing")
        page.fill("#q-strategy", OWN_ANSWERS["strategy"])
        page.get_by_label("Often").check()
        for device in ("Telephone", "Computer"):
            page.get_by_label(device).check()
        page.get_by_role("radiogroup", name="How sure were you?").get_by_label("4").check()
        # An answer to an optional scale can be taken back.
        optional = page.get_by_role("radiogroup", name="Was it fun?")
        optional.get_by_label("2").check()
        visit.picture("answered")
        # The choice of no answer is no part of the scale.
        ends = optional.locator(".scale-ends").bounding_box()
        none = optional.locator(".scale-ends + .radio").bounding_box()
        assert none["y"] - (ends["y"] + ends["height"]) >= 10
        optional.get_by_label("I prefer not to say").check()
        visit.main_button().click()
        page.check("#difficulty-4")
        page.check("#technical-no")
        visit.main_button().click()
        page.locator("#code").wait_for()
        assert visit.unexpected() == []
        session, _, _ = rows_of(study, "Ada")
        assert session.own_answers == OWN_ANSWERS | {
            "devices": ["phone", "computer"],
            "fun": None,
        }
