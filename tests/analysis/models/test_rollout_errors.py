"""Errors of imagined motion over time: means, intervals, reading."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from physion.analysis import Bootstrap
from physion.analysis.models.rollout_errors import (
    COLUMNS,
    CONSTANT_VELOCITY,
    REQUIRED,
    read_rollout_errors,
    rollout_error_table,
)
from physion.errors import BadInputError

FRAMES = (3, 6, 9)


def errors_of(model: str, speeds: dict[str, list[float]], baseline: float = 0.02) -> pd.DataFrame:
    """Errors that grow linearly: by each speed (m a frame) for a trial of the scenario."""
    rows = [
        (model, scenario, f"{scenario}_{trial}", frame, speed * frame, baseline * frame)
        for scenario, values in speeds.items()
        for trial, speed in enumerate(values)
        for frame in FRAMES
    ]
    return pd.DataFrame(rows, columns=list(REQUIRED))


def write(path: Path, table: pd.DataFrame) -> Path:
    table.to_csv(path, index=False)
    return path


def test_curves_are_means_over_trials_with_intervals(tmp_path: Path) -> None:
    speeds = {"drop": [0.1, 0.2, 0.3, 0.4], "collide": [0.5] * 4}
    table = write(tmp_path / "a.csv", errors_of("sim", speeds))
    curves = rollout_error_table(read_rollout_errors([table]), Bootstrap(400))
    assert tuple(curves.columns) == COLUMNS
    assert list(curves["panel"].unique()) == ["collide", "drop", "mean"]
    drop = curves[(curves["panel"] == "drop") & (curves["agent"] == "sim")]
    assert drop["seconds"].tolist() == pytest.approx([0.03, 0.06, 0.09])
    assert drop["value"].tolist() == pytest.approx([0.75, 1.5, 2.25])
    assert (drop["trials"] == 4).all()
    # Means of four draws of 0.1 to 0.4: standard error 0.056, so 95 % within about 0.11.
    last = drop.iloc[-1]
    assert 9 * (0.25 - 0.14) < last["low"] < 9 * (0.25 - 0.07)
    assert 9 * (0.25 + 0.07) < last["high"] < 9 * (0.25 + 0.14)
    still = curves[(curves["panel"] == "collide") & (curves["agent"] == "sim")]
    assert still["low"].tolist() == pytest.approx(still["high"].tolist())
    mean = curves[(curves["panel"] == "mean") & (curves["agent"] == "sim")]
    assert mean["value"].tolist() == pytest.approx([1.125, 2.25, 3.375])
    assert mean["trials"].tolist() == [8, 8, 8]
    half = (last["high"] - last["low"]) / 2
    wide = mean.iloc[-1]["high"] - mean.iloc[-1]["low"]
    assert wide == pytest.approx(half, rel=0.05), "one of two scenarios varies"


def test_the_baseline_is_constant_velocity_of_the_first_model(tmp_path: Path) -> None:
    first = write(tmp_path / "a.csv", errors_of("one", {"drop": [0.1, 0.2]}, baseline=0.05))
    second = write(tmp_path / "b.csv", errors_of("two", {"drop": [0.3, 0.4]}, baseline=0.06))
    curves = rollout_error_table(read_rollout_errors([first, second]), Bootstrap(50))
    assert list(curves["agent"].unique()) == ["one", "two", CONSTANT_VELOCITY]
    assert list(curves["panel"].unique()) == ["drop"], "one scenario has no mean over scenarios"
    base = curves[curves["kind"] == "baseline"]
    assert base["value"].tolist() == pytest.approx([0.15, 0.3, 0.45])


def test_trials_that_end_earlier_are_left_out_from_there(tmp_path: Path) -> None:
    table = errors_of("sim", {"drop": [0.1, 0.2, 0.9]})
    table = table.drop(table.index[-1])
    curves = rollout_error_table(
        read_rollout_errors([write(tmp_path / "a.csv", table)]), Bootstrap(200)
    )
    own = curves[curves["agent"] == "sim"]
    assert own["trials"].tolist() == [3, 3, 2]
    assert own["value"].tolist() == pytest.approx([1.2, 2.4, 1.35])
    assert np.isfinite(own[["low", "high"]].to_numpy()).all() and own["high"].iloc[-1] < 1.9


def test_one_model_in_several_files_is_named_with_each(tmp_path: Path) -> None:
    paths = [
        write(tmp_path / f"dpi-{name}.csv", errors_of("dpi", {"drop": [0.1]})) for name in "ab"
    ]
    assert set(read_rollout_errors(paths)["agent"]) == {"dpi, dpi-a", "dpi, dpi-b"}


def test_other_tables_are_refused(tmp_path: Path) -> None:
    table = errors_of("sim", {"drop": [0.1]})
    with pytest.raises(BadInputError, match=r"lacks the column\(s\) Error"):
        read_rollout_errors([write(tmp_path / "a.csv", table.drop(columns="Error"))])
    twice = pd.concat([table, table.iloc[1:2]])
    with pytest.raises(BadInputError, match="row 4 repeats a model, stimulus and frame: 'drop_0'"):
        read_rollout_errors([write(tmp_path / "b.csv", twice)])
    table["Error"] = ["0.1", "far", "0.2"]
    with pytest.raises(BadInputError, match="row 2 of column 'Error' holds 'far'"):
        read_rollout_errors([write(tmp_path / "c.csv", table)])
