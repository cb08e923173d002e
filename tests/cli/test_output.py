"""What verbs print: tables, counts, progress, names, numbers of replay and of measurements."""

from __future__ import annotations

import dataclasses
import json
import math
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import physion.core.registry
from physion.cli import output, replay
from physion.cli.bench import COLUMNS
from physion.cli.ls import DESCRIBED
from physion.cli.main import main
from physion.compute.run_tasks import RunReport
from physion.core.registry import Registry
from physion.core.version import MADE_WITH
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


def test_every_number_of_a_replay_stands_below_its_name(capsys: pytest.CaptureFixture[str]) -> None:
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


# --- lists of names -----------------------------------------------------------------------------


@pytest.mark.parametrize("kind", DESCRIBED)
def test_every_name_has_a_line_that_says_what_it_is(
    kind: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["ls", kind]) == 0
    lines = capsys.readouterr().out.splitlines()
    names = DESCRIBED[kind]().names()
    assert [line.partition(": ")[0] for line in lines] == names and len(names) >= 2
    texts = [line.partition(": ")[2] for line in lines]
    assert all(text.endswith(".") and len(text) > 10 for text in texts)
    assert len(set(texts)) == len(names), "each says how it differs"
    assert main(["ls", kind, "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {kind: names}


def test_plug_ins_are_described_without_being_imported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = 'raise OSError\nclass Mine:\n    """What it is.\n\n    And more."""\nbare = 1\n'
    (tmp_path / "plug_in_of_a_test.py").write_text(text)
    monkeypatch.syspath_prepend(tmp_path)

    def points(group: str) -> list[EntryPoint]:
        targets = {"mine": "plug_in_of_a_test:Mine", "bare": "plug_in_of_a_test:bare",
                   "absent": "package_that_is_not_there.inner:Mine"}  # fmt: skip
        return [EntryPoint(name, target, group) for name, target in targets.items()]

    monkeypatch.setattr(physion.core.registry, "entry_points", points)
    fresh: Registry[object] = Registry("model")
    assert {name: fresh.describe(name) for name in fresh} == {
        "mine": "What it is.", "bare": "", "absent": "",
    }  # fmt: skip


# --- replay -------------------------------------------------------------------------------------


@pytest.fixture
def log(tmp_path: Path) -> Path:
    """A folder with one trial: a cube that falls on the zone."""

    def cube(id_: int, y: float, scale: tuple[float, float, float]) -> list[dict[str, Any]]:
        x_y_z = {"x": 0.0, "y": y, "z": 0.0}
        still = {"x": 0.0, "y": 0.0, "z": 0.0}
        factor = dict(zip("xyz", scale, strict=True))
        create = {"$type": "add_object", "id": id_, "name": "cube", "category": "flex_primitive"}
        return [
            {**create, "position": x_y_z, "rotation": still},
            {"$type": "scale_object", "id": id_, "scale_factor": factor},
            {"$type": "set_mass", "id": id_, "mass": 2.0},
        ]

    kinematic = {"$type": "set_kinematic_state", "id": 1, "is_kinematic": True}
    start = [*cube(1, 0.0, (2, 0.01, 2)), kinematic, *cube(2, 0.5, (0.2, 0.2, 0.2))]
    record = {
        "stimulus_name": "fall_0000",
        "controller_name": "Drop",
        "does_target_contact_zone": True,
        "first_target_contact_zone_frame": 31,
        "num_frames": 151,
        "final_target_displacement": {"x": 0.0, "y": 0.11, "z": 0.0},
    }
    (tmp_path / "tdw_commands.json").write_text(f"[] trial None\n{json.dumps(start)} trial 0\n")
    (tmp_path / "metadata.json").write_text(json.dumps([record]))
    return tmp_path


@pytest.mark.nightly
@pytest.mark.slow
def test_every_engine_has_a_row_and_every_column_a_legend(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "replay.json"
    options = ["--engines", "physion,mujoco", "--repeats", "2", "--workers", "1"]
    assert main(["replay", str(log), *options, "--json", str(out)]) == 0
    text = " ".join(capsys.readouterr().out.split())
    for column in ("jittered", "ceiling", "Brier", "log", "frames", "final"):
        assert f"{column}: " in text
    assert "AUC" not in text  # there is no cloth
    content = json.loads(out.read_text())
    engines = [(row["engine"], row["trials"]) for row in content["scenarios"]]
    assert engines == [("physion", 1), ("mujoco", 1)]
    for row in content["scenarios"]:
        assert row["agreement"] == row["jittered_agreement"] == row["ceiling"] == 1.0
        # The cube rests on the zone, .01 m high; .11 m were recorded.
        assert row["final_error"] == pytest.approx(0.1, abs=2e-3)
        assert row["frame_difference"] <= 2 and row["auc"] is None
    assert [trial["jittered"] for trial in content["trials"]] == [[True, True]] * 2


def test_an_unknown_engine_is_refused_with_the_closest_names(
    log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", str(log), "--engine", "mujocco"]) == 2
    assert "mujoco" in capsys.readouterr().err


# --- doctor --bench -----------------------------------------------------------------------------


@pytest.mark.nightly
@pytest.mark.slow
def test_every_quantity_of_a_scenario_is_measured(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--bench", "--scenario", "drop", "--count", "1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["package"] == MADE_WITH and found["count"] == 1
    (row,) = found["scenarios"]
    assert row.keys() == COLUMNS.keys() and row.pop("scenario") == "drop"
    assert row.pop("agreement") in (0.0, 1.0)
    assert all(math.isfinite(value) and value > 0 for value in row.values())
    # One trial was made: its frames over its two times are a whole number, at most 3 s of them.
    frames = row["frames_per_s"] * (row["choose_s"] + row["make_s"])
    assert frames == pytest.approx(round(frames), abs=1e-6) and 45 < frames <= 302


@pytest.mark.parametrize(
    ("options", "word"), [(["--count", "0"], "--count"), (["--scenario", "dorp"], "drop")]
)
def test_bad_options_are_one_line(
    options: list[str], word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["doctor", "--bench", *options]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and word in message
