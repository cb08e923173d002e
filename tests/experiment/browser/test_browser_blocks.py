"""A session that runs through several scenarios, in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.server_process import ServerProcess
from physion.experiment.study.orders import block_scenarios
from physion.experiment.study.settings import Blocks, Recruitment
from physion.experiment.study.texts import TEXTS_FOLDER
from support.experiment.browser import FAST, SHORT, Visit, chromium, rows_of
from support.experiment.tiny_study import make_tiny_study

__all__ = ["chromium"]
pytestmark = pytest.mark.slow
PROMPT = '\n[scenario.drop.trial]\nprompt = "Will the falling object be hit?"\n'


def test_a_session_of_two_blocks(chromium: Any, tmp_path: Path) -> None:
    study = make_tiny_study(
        tmp_path, test=4, familiarization=1, scenarios=("collide", "drop"), languages=("en",),
        blocks=Blocks(all_scenarios=True, trials=2), timing=SHORT,
        plausibility=FAST, recruitment=Recruitment(link_code="TINY-CODE"),
    )  # fmt: skip
    with (tmp_path / TEXTS_FOLDER / "en.toml").open("a") as texts:
        texts.write(PROMPT)
    with (
        ServerProcess(study.folder) as server,
        Visit(chromium, server.url, "blocks") as visit,
    ):
        visit.go("?participant=Ada")
        visit.heading("Taking part in this study")
        assert "6 short movies" in visit.page.inner_text("main")
        visit.begin("?participant=Ada")
        visit.practise(1)
        visit.heading("You are ready")
        assert "2 movies follow" in visit.page.inner_text("main")
        visit.begin_test()
        visit.page.get_by_text("Part 1 of 2 · Trial 1 of 4").wait_for()
        first = visit.page.inner_text("#prompt")
        visit.answer("yes")
        visit.answer("no")
        for _ in range(2):  # a reload shows the page again
            visit.heading("Part 2 of 2")
            said = visit.page.inner_text("main")
            assert "You have answered 2 of 4 movies" in said and "1 practice movies" in said
            assert "From now on the question is: Will" in said
            visit.picture("block")
            visit.page.reload()
        visit.heading("Part 2 of 2")
        visit.page.get_by_role("button", name="Go on").click()
        visit.page.get_by_text("Part 2 of 2 · Practice 2 of 2").wait_for()
        assert visit.page.locator("#bar").evaluate("bar => [bar.value, bar.max]") == [3, 6]
        visit.practise(1)
        visit.begin_test()
        visit.page.get_by_text("Part 2 of 2 · Trial 3 of 4").wait_for()
        assert visit.page.inner_text("#prompt") != first
        visit.answer("yes")
        visit.answer("yes")
        visit.finish()
        visit.heading("Thank you!")
        assert "of 4 movies" in visit.page.inner_text("main")
        assert visit.unexpected() == []
    session, answers, _ = rows_of(study, "Ada")
    order = block_scenarios(study, session.scenario, session.order_seed)
    shown = [(row.phase, row.trial, row.stimulus.split("_")[0]) for row in answers]
    assert sorted(shown) == sorted([
        ("familiarization", 0, order[0]), ("familiarization", 1, order[1]),
        ("test", 0, order[0]), ("test", 1, order[0]), ("test", 2, order[1]), ("test", 3, order[1]),
    ])  # fmt: skip
    assert session.implausible is None and session.finished_at is not None
