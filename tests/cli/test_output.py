"""What verbs print: tables, counts, lines of progress, numbers of every column."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from physion.cli import output, replay
from physion.compute.run_tasks import RunReport
from physion.physics.replay import ReplayRow
from physion.scenes.tdw.read_logs import TrialSet


@pytest.mark.parametrize(
    ("done", "seconds", "lines"),
    [
        ((0, 5, 10, 15, 20), 20, ["trials: 10 of 50, 160 s left", "trials: 20 of 50, 120 s left"]),
        ((0, 1), 60, ["trials: 1 of 50"]),  # the first item says nothing of the rest
        ((0, 50), 5, []),
    ],
)
def test_long_work_is_reported_in_lines(
    done: tuple[int, ...],
    seconds: float,
    lines: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    now = 100.0
    monkeypatch.setattr(output.time, "monotonic", lambda: now)
    with output.Stages() as stages:
        for count in done:
            stages("trials", count, 50)
            now += seconds
    assert capsys.readouterr().err.splitlines() == lines


def test_stages_are_named_when_they_begin(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The first at once, others unless they follow each other quickly."""
    now = 100.0
    monkeypatch.setattr(output.time, "monotonic", lambda: now)
    with output.Stages(at_once=True) as stages:
        for what, seconds in (("models", 1), ("scenes", 3), ("trials", 1), ("movies", 9)):
            stages(what, 0, 5)
            now += seconds
            stages(what, 5, 5)
    assert capsys.readouterr().err.splitlines() == ["models: 0 of 5", "trials: 0 of 5"]


def test_a_table_has_three_decimals_and_keeps_its_columns() -> None:
    table = pd.DataFrame(
        {"model": ["a", "longer"], "r": [0.12345, -0.5], "trials": [7, 12], "known": [np.nan, 2.0],
         "why": [None, "few"]}
    )  # fmt: skip
    assert output.text_table(table, "Title").splitlines() == [
        "Title",
        "model        r  trials  known  why",
        "a        0.123       7",
        "longer  -0.500      12      2  few",
    ]


def test_trials_made_kept_and_failed_are_counted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    notes = {"t": [f"note {n}" for n in range(7)]}
    report = RunReport(["a", "b", "c"], ["d", "e"], {"f": "broken"}, tmp_path / "index", notes)
    assert output.print_report(report, as_json=False) == 1
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "failed: f: broken" and lines[1] == "note: t: note 0"
    assert lines[6:] == [
        "... and 2 more notes (--json lists all)",
        f"3 made, 2 kept, 1 failed: {tmp_path / 'index'}",
    ]
    assert output.print_report(report, as_json=True) == 1
    values = json.loads(capsys.readouterr().out)
    assert (values["made"], values["kept"]) == (["a", "b", "c"], ["d", "e"])


def test_every_number_of_a_replay_stands_below_its_name(
    capsys: pytest.CaptureFixture[str],
) -> None:
    names = [field.name for field in dataclasses.fields(ReplayRow)]
    numbers = {name: 0.011 * (k + 1) for k, name in enumerate(names)}
    values = numbers | {"scenario": "drop", "trials": 9, "milliseconds": 31.0, "real_time": 47.0}
    rows = [ReplayRow(**{**values, "engine": name}) for name in ("one", "two")]  # type: ignore[arg-type]
    replay._print(replay.ReplayResult(rows, [], 5, 3, ["broken"]), TrialSet())
    text = capsys.readouterr().out
    header, first = (line.split() for line in text.splitlines()[1:3])
    shown = dict(zip(header, first, strict=True))
    headings = {
        "agree": "agreement", "jittered": "jittered_agreement", "ceiling": "ceiling",
        "Brier": "brier", "log": "log_score", "AUC": "auc", "frames": "frame_difference",
        "final": "final_error", "base": "base_rate",
    }  # fmt: skip
    assert {name: shown[name] for name in headings} == {
        name: f"{values[key]:.3f}" for name, key in headings.items()
    }
    assert (shown["trials"], shown["ms"], shown["speed"]) == ("9", "31", "47")
    assert "duplicates left out: 5;" in text
    assert "has no cloth: 3" in text and "failures: 1" in text
