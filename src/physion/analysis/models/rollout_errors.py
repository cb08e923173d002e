"""Errors of imagined motion over time, by scenario and model, next to constant velocity.

The mean over trials at each time after the last observed frame; intervals draw trials, the same
ones for all models that have the same number of trials of a scenario.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.tables.csv_table import as_numbers, read_csv
from physion.analysis.tables.stimuli import MEAN, in_order
from physion.errors import BadInputError

CONSTANT_VELOCITY = "constant velocity"
"""Name of the baseline: objects go on as they moved in the last observed step."""
REQUIRED = ("Model", "Scenario", "Stimulus Name", "Frames", "Error", "Constant Velocity Error")
"""Columns of a file of errors, which ``physion evaluate --rollout-error`` writes."""
COLUMNS = ("panel", "agent", "kind", "seconds", "trials", "value", "low", "high")
"""``panel``: scenario or `MEAN`; ``kind``: model or baseline; ``seconds`` of physics after the last
observed frame; ``value``: mean error in metres, with its interval."""
_FRAME = 0.01
_FARTHEST = 1e6

Array = npt.NDArray[np.float64]


def read_rollout_errors(paths: Sequence[Path]) -> pd.DataFrame:
    """Read files of errors: columns ``agent``, ``scenario``, ``stimulus``, ``seconds``, ``error``,
    ``baseline``.

    A model that is in several files is named with each file. Raises `BadInputError` for a file that
    is no such table.
    """
    tables = {path: read_csv(path, REQUIRED) for path in paths}
    count = Counter(name for table in tables.values() for name in set(table["Model"]))
    parts = []
    for path, table in tables.items():
        agent = [f"{m}, {path.stem}" if count[m] > 1 else m for m in table["Model"]]
        numbers = {
            name: as_numbers(table[column], 0, _FARTHEST, str(path))
            for name, column in (
                ("seconds", "Frames"),
                ("error", "Error"),
                ("baseline", "Constant Velocity Error"),
            )
        }
        names = {"scenario": table["Scenario"], "stimulus": table["Stimulus Name"]}
        part = pd.DataFrame({"agent": agent, **names, **numbers})
        part["seconds"] *= _FRAME
        repeated = part.duplicated(["agent", "stimulus", "seconds"])
        if repeated.any():
            row = int(np.flatnonzero(repeated)[0])
            raise BadInputError(
                f"{path}: row {row + 1} repeats a model, stimulus and frame: "
                f"{part['stimulus'].iloc[row]!r}"
            )
        parts.append(part)
    return pd.concat(parts, ignore_index=True)


def rollout_error_table(errors: pd.DataFrame, bootstrap: Bootstrap) -> pd.DataFrame:
    """Return mean errors with intervals; `COLUMNS`.

    The baseline is that of the first model, since the step of a model decides its last velocity. A
    panel `MEAN` with the mean over scenarios follows if there are several.

    Parameters
    ----------
    errors
        From `read_rollout_errors`.
    bootstrap
        Draws of the intervals.
    """
    agents = list(dict.fromkeys(errors["agent"]))
    scenarios = in_order(set(errors["scenario"]))
    curves = [(agent, "model", "error", agent) for agent in agents]
    curves.append((CONSTANT_VELOCITY, "baseline", "baseline", agents[0]))
    rows: list[pd.DataFrame] = []
    for name, kind, column, agent in curves:
        own = errors[errors["agent"] == agent]
        draws = {
            scenario: _draws(own[own["scenario"] == scenario], column, scenario, bootstrap)
            for scenario in scenarios
            if (own["scenario"] == scenario).any()
        }
        if len(draws) > 1:
            draws[MEAN] = _mean_over_scenarios(list(draws.values()))
        rows += [
            _rows(values, bootstrap).assign(panel=panel, agent=name, kind=kind)
            for panel, values in draws.items()
        ]
    table = pd.concat(rows, ignore_index=True)[list(COLUMNS)]
    order = {panel: place for place, panel in enumerate([*scenarios, MEAN])}
    return table.sort_values(
        "panel", key=lambda panels: panels.map(order), kind="stable", ignore_index=True
    )


def _draws(rows: pd.DataFrame, column: str, scenario: str, bootstrap: Bootstrap) -> pd.DataFrame:
    """Return by time the number of trials, the mean, and its draws as further columns 0, 1, ..."""
    wide = rows.pivot(index="stimulus", columns="seconds", values=column).sort_index()
    values: Array = wide.to_numpy(dtype=np.float64)
    known = np.isfinite(values).astype(np.float64)
    weights = np.concatenate([np.ones((1, len(values))), bootstrap.weights(scenario, len(values))])
    counts = weights @ known
    with np.errstate(invalid="ignore"):
        means = (weights @ np.nan_to_num(values)) / np.where(counts > 0, counts, np.nan)
    table = pd.DataFrame(means[1:].T, index=wide.columns)
    table.insert(0, "trials", known.sum(axis=0).astype(int))
    table.insert(1, "value", means[0])
    return table


def _mean_over_scenarios(parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return the mean of scenarios, and of their draws, at the times that all have."""
    times = sorted(set.intersection(*(set(part.index) for part in parts)))
    aligned = [part.loc[times] for part in parts]
    mean = sum(aligned[1:], aligned[0]) / len(aligned)
    mean["trials"] = sum(part["trials"] for part in aligned)
    return mean


def _rows(draws: pd.DataFrame, bootstrap: Bootstrap) -> pd.DataFrame:
    samples = draws.drop(columns=["trials", "value"]).to_numpy(dtype=np.float64)
    intervals = np.array([bootstrap.interval(row) for row in samples]).reshape(-1, 2)
    return pd.DataFrame(
        {
            "seconds": draws.index.to_numpy(dtype=np.float64),
            "trials": draws["trials"].to_numpy(dtype=int),
            "value": draws["value"].to_numpy(dtype=np.float64),
            "low": intervals[:, 0],
            "high": intervals[:, 1],
        }
    )
