"""A session in a condition with its own question and without feedback, in a real browser."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.server_process import ServerProcess
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.settings import Condition
from physion.experiment.study.study import write_settings
from physion.experiment.study.texts import TEXTS_FOLDER
from support.experiment.browser import FAST, SHORT, Visit, chromium, rows_of
from support.experiment.tiny_study import make_tiny_study

__all__ = ["chromium"]
pytestmark = pytest.mark.slow
CONDITIONS = (
    Condition("usual"),
    Condition("plain", cue_ms=200, break_every=1, familiarization_feedback=False),
)
TEXTS = """
[condition.plain.instructions]
answer = "First {practice}, then {trials} movies."
[condition.plain.ready]
text = "{trials} movies follow."
[condition.plain.trial]
prompt = "Do they meet?"
"""


def test_a_condition_has_its_own_settings_and_texts(chromium: Any, tmp_path: Path) -> None:
    study = make_tiny_study(
        tmp_path, test=2, familiarization=1, languages=("en",), timing=SHORT,
        plausibility=FAST,
    )  # fmt: skip
    with (tmp_path / TEXTS_FOLDER / "en.toml").open("a") as texts:
        texts.write(TEXTS)
    write_settings(replace(study, conditions=CONDITIONS))
    key = make_pass(Secrets.load(study.folder), "study", "link", "condition", "plain")
    with ServerProcess(study.folder) as server, Visit(chromium, server.url, "condition") as visit:
        visit.begin(f"?participant=Ada&condition=plain&pass={key}")
        visit.answer("yes")
        visit.heading("You are ready")  # no feedback before
        assert "2 movies follow." in visit.page.inner_text("main")
        visit.begin_test()
        assert visit.page.inner_text("#prompt") == "Do they meet?"
        visit.answer("yes")
        visit.heading("Time for a break")
        visit.page.get_by_role("button", name="Go on").click()
        visit.answer("no")
        visit.heading("About you")
        assert visit.unexpected() == []
    session, answers, _ = rows_of(study, "Ada")
    assert session.condition == "plain"
    cues = [answer.cue_ms for answer in answers]
    # A busy machine may prolong a cue, but not all of them by so much.
    assert 150 < min(cues) < 450
