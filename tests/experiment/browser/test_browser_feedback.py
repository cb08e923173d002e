"""Practice feedback, and texts that differ by scenario, in a real browser."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.server_process import ServerProcess
from physion.experiment.study.texts import TEXTS_FOLDER
from support.experiment.browser import SHORT, Visit, chromium, rows_of, served
from support.experiment.tiny_study import make_tiny_study

__all__ = ["chromium"]
pytestmark = pytest.mark.slow
COUNT_FLASHES = """
window.flashes = 0;
new MutationObserver((changes) => {
  for (const { target } of changes)
    if (target.matches?.(".has-verdict .screen-map") && !target.hidden) window.flashes += 1;
}).observe(document, { subtree: true, attributes: true, attributeFilter: ["hidden"] });
"""
VERDICTS = (
    "The object that flashed red touches the object that flashed yellow.",
    "The object that flashed red does not touch the object that flashed yellow.",
)


def test_feedback_shows_the_map_and_is_kept_over_a_reload(chromium: Any, tmp_path: Path) -> None:
    with (
        served(tmp_path, test=1, familiarization=2) as (study, server),
        Visit(chromium, server.url, "feedback") as visit,
    ):
        visit.context.add_init_script(COUNT_FLASHES)
        visit.begin("?participant=Learns")
        for verdict in VERDICTS:  # the second is that of the last practice trial
            visit.answer("yes")
            visit.page.get_by_text(verdict).wait_for()
            visit.page.reload()
            visit.page.get_by_text(verdict).wait_for()
            visit.main_button().wait_for()
            visit.picture("again")
            assert visit.page.evaluate("flashes") == 1  # 0.5 s at 2 Hz
            visit.main_button().click()
        visit.begin_test()
        visit.page.reload()
        visit.answer("yes")
        visit.heading("About you")
        assert visit.unexpected() == []
    answers = rows_of(study, "Learns")[1]
    assert [(row.phase, row.response) for row in answers] == [
        ("familiarization", "yes"), ("familiarization", "yes"), ("test", "yes"),
    ]  # fmt: skip


def test_title_and_question_differ_by_scenario(chromium: Any, tmp_path: Path) -> None:
    own = (
        '[study]\ntitle = "Was geschieht?"\n[scenario.drop.study]\ntitle = "Was fällt?"\n'
        '[scenario.drop.trial]\nprompt = "Trifft es?"\n'
    )
    study = make_tiny_study(
        tmp_path, test=1, familiarization=1, scenarios=("collide", "drop"), timing=SHORT
    )
    path = study.folder / TEXTS_FOLDER / "de.toml"
    path.write_text(path.read_text() + own)
    with ServerProcess(study.folder) as server, Visit(chromium, server.url) as visit:
        for scenario, title, prompt in (
            ("drop", "Was fällt?", "Trifft es?"),
            ("collide", "Was geschieht?", "Wird der rote Gegenstand den gelben berühren?"),
        ):
            visit.go(f"?participant={scenario}&scenario={scenario}&language=de")
            visit.heading("Teilnahme an dieser Studie")
            assert visit.page.inner_text("#title") == visit.page.title() == title
            visit.main_button().click()
            visit.heading("Was Sie tun")
            visit.page.get_by_text(prompt).wait_for()
        visit.go("?participant=Ada&language=en")
        visit.heading("Taking part in this study")
        assert visit.page.inner_text("#title") == "A tiny study"
        assert visit.unexpected() == []
