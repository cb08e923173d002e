"""On an idle machine every trial shows all of its 45 frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

from physion.experiment.study.settings import Timing
from support.experiment.browser import Visit, chromium, rows_of, served

__all__ = ["chromium"]
pytestmark = [pytest.mark.slow, pytest.mark.alone]
TRIALS = 10
SESSIONS = 8
"""Something may wake up even on an idle machine: one session of these without a gap is enough."""


def test_45_frames_are_shown_in_every_trial(chromium: Any, tmp_path: Path) -> None:
    shown: list[list[int | None]] = []
    timing = Timing(fixation_ms=(200, 300), cue_ms=1000)
    with served(
        tmp_path, test=TRIALS, familiarization=1, size=256, timing=timing
    ) as (study, server):  # fmt: skip
        for number in range(SESSIONS):
            with Visit(chromium, server.url) as visit:
                visit.begin(f"?participant=Frames{number}")
                visit.practise(1)
                visit.begin_test()
                for _ in range(TRIALS):
                    visit.answer("no")
                visit.heading("About you")
            _, answers, _ = rows_of(study, f"Frames{number}")
            test = [row for row in answers if row.phase == "test"]
            assert {row.frames_expected for row in test} == {45}
            shown.append([row.frames_shown for row in test])
            if shown[-1] == [45] * TRIALS:
                return
    pytest.fail(f"frames shown, by session: {shown}")
