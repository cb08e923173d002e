"""Errors of imagined motion over time: means, intervals, reading."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from physion.analysis.rollout_errors import (
    COLUMNS,
    CONSTANT_VELOCITY,
    ERRORS,
    read_rollout_errors,
    rollout_error_table,
)
from physion.core.errors import BadInputError

FRAMES = (3, 6, 9)


def errors_of(model: str, speeds: dict[str, list[float]], baseline: float = 0.02) -> pd.DataFrame:
    """Errors that grow linearly: by each speed (m a frame) for a trial of the scenario."""
    rows = [
        (model, scenario, f"{scenario}_{trial}", frame, speed * frame, baseline * frame)
        for scenario, values in speeds.items()
        for trial, speed in enumerate(values)
        for frame in FRAMES
    ]
    return pd.DataFrame(rows, columns=[column.name for column in ERRORS])


def write(path: Path, table: pd.DataFrame) -> Path:
    table.to_csv(path, index=False)
    return path


def test_curves_are_means_over_trials_with_intervals(tmp_path: Path) -> None:
    speeds = {"drop": [0.1, 0.2, 0.3, 0.4], "collide": [0.5] * 4}
    table = write(tmp_path / "a.csv", errors_of("sim", speeds))
    curves = rollout_error_table(read_rollout_errors([table]))
    assert tuple(curves.columns) == COLUMNS
    assert list(curves["panel"].unique()) == ["collide", "drop", "mean"]
    drop = curves[(curves["panel"] == "drop") & (curves["model"] == "sim")]
    assert drop["seconds"].tolist() == pytest.approx([0.03, 0.06, 0.09])
    assert drop["value"].tolist() == pytest.approx([0.75, 1.5, 2.25])
    assert (drop["trials"] == 4).all()
    # Four trials: standard error sd / 2, Student's t with 3 degrees of freedom, on the log scale.
    last = drop.iloc[-1]
    reach = 3.1824 * np.std([0.1, 0.2, 0.3, 0.4], ddof=1) / 2 / 0.25
    assert last["low"] == pytest.approx(2.25 * np.exp(-reach), rel=1e-4)
    assert last["high"] == pytest.approx(2.25 * np.exp(reach), rel=1e-4)
    still = curves[(curves["panel"] == "collide") & (curves["model"] == "sim")]
    assert still["low"].tolist() == pytest.approx(still["high"].tolist())
    mean = curves[(curves["panel"] == "mean") & (curves["model"] == "sim")]
    assert mean["value"].tolist() == pytest.approx([1.125, 2.25, 3.375])
    assert mean["trials"].tolist() == [8, 8, 8]
    reaches = [row["value"] * np.log(row["high"] / row["low"]) for row in (last, mean.iloc[-1])]
    assert reaches[1] == pytest.approx(reaches[0] / 2), "one of two scenarios varies"


def test_the_baseline_is_constant_velocity_of_the_first_model(tmp_path: Path) -> None:
    first = write(tmp_path / "a.csv", errors_of("one", {"drop": [0.1, 0.2]}, baseline=0.05))
    second = write(tmp_path / "b.csv", errors_of("two", {"drop": [0.3, 0.4]}, baseline=0.06))
    curves = rollout_error_table(read_rollout_errors([first, second]))
    assert list(curves["model"].unique()) == ["one", "two", CONSTANT_VELOCITY]
    assert list(curves["panel"].unique()) == ["drop"], "one scenario has no mean over scenarios"
    base = curves[curves["kind"] == "baseline"]
    assert base["value"].tolist() == pytest.approx([0.15, 0.3, 0.45])


def test_trials_that_end_earlier_are_left_out_from_there(tmp_path: Path) -> None:
    table = errors_of("sim", {"drop": [0.1, 0.2, 0.9]})
    table = table.drop(table.index[-1])
    curves = rollout_error_table(read_rollout_errors([write(tmp_path / "a.csv", table)]))
    own = curves[curves["model"] == "sim"]
    assert own["trials"].tolist() == [3, 3, 2]
    assert own["value"].tolist() == pytest.approx([1.2, 2.4, 1.35])
    assert own["value"].between(own["low"], own["high"], inclusive="neither").all()


def test_one_model_in_several_files_is_named_with_each(tmp_path: Path) -> None:
    paths = [
        write(tmp_path / f"dpi-{name}.csv", errors_of("dpi", {"drop": [0.1]})) for name in "ab"
    ]
    assert set(read_rollout_errors(paths)["model"]) == {"dpi, dpi-a", "dpi, dpi-b"}


def test_other_tables_are_refused(tmp_path: Path) -> None:
    table = errors_of("sim", {"drop": [0.1]})
    with pytest.raises(BadInputError, match=r"lacks the column\(s\) error"):
        read_rollout_errors([write(tmp_path / "a.csv", table.drop(columns="error"))])
    twice = pd.concat([table, table.iloc[1:2]])
    with pytest.raises(BadInputError, match="row 4 repeats a model, stimulus and frame: 'drop_0'"):
        read_rollout_errors([write(tmp_path / "b.csv", twice)])
    table["error"] = ["0.1", "far", "0.2"]
    with pytest.raises(BadInputError, match="row 2 of column 'error' holds 'far'"):
        read_rollout_errors([write(tmp_path / "c.csv", table)])
