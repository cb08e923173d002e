"""Errors of imagined motion over time, by scenario and model, next to constant velocity.

The mean over trials at each time after the last observed frame; intervals are about other trials.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.intervals import Variance, mean_of, variance_of_mean
from physion.analysis.tables import MEAN, in_order
from physion.core.errors import BadInputError
from physion.core.tables import Column, check_table, must, read_csv

CONSTANT_VELOCITY = "constant velocity"
"""Name of the baseline: objects keep moving as they did in the last observed step."""
ERRORS: tuple[Column, ...] = (
    must("model", "text", "Name of the model", also=("Model",)),
    must("scenario", "text", "Scenario of the trial", also=("Scenario",)),
    must("stimulus", "text", "Name of the trial", also=("Stimulus Name",)),
    must("frames", "integer", "Frames after the last observed one", low=0, also=("Frames",)),
    must("error", "number", "Mean distance from the true positions", unit="m", low=0, high=1e6,
         also=("Error",)),
    must("constant_velocity_error", "number", "The same of objects that keep their last velocity",
         unit="m", low=0, high=1e6, also=("Constant Velocity Error",)),
)  # fmt: skip
"""Columns of a file of errors, which ``physion evaluate --option rollout_errors=true`` writes."""
COLUMNS = ("panel", "model", "kind", "seconds", "trials", "value", "low", "high")
"""``panel``: scenario or `MEAN`; ``kind``: model or baseline; ``seconds`` of physics after the last
observed frame; ``value``: mean error in metres, with its interval."""
_FRAME = 0.01

Array = npt.NDArray[np.float64]


def read_rollout_errors(paths: Sequence[Path]) -> pd.DataFrame:
    """Read files of errors: columns ``model``, ``scenario``, ``stimulus``, ``seconds``, ``error``,
    ``baseline``.

    A model that is in several files is named with each file. Raises `BadInputError` for a file that
    is not such a table.
    """
    tables = {path: check_table(read_csv(path), ERRORS, str(path)) for path in paths}
    count = Counter(name for table in tables.values() for name in set(table["model"]))
    parts = []
    for path, table in tables.items():
        model = [f"{m}, {path.stem}" if count[m] > 1 else m for m in table["model"]]
        names = {"model": model, "scenario": table["scenario"], "stimulus": table["stimulus"]}
        part = pd.DataFrame(
            {
                **names,
                "seconds": table["frames"].astype(float),
                "error": table["error"],
                "baseline": table["constant_velocity_error"],
            }
        )
        part["seconds"] *= _FRAME
        repeated = part.duplicated(["model", "stimulus", "seconds"])
        if repeated.any():
            row = int(np.flatnonzero(repeated)[0])
            raise BadInputError(
                f"{path}: row {row + 1} repeats a model, stimulus and frame: "
                f"{part['stimulus'].iloc[row]!r}"
            )
        parts.append(part)
    return pd.concat(parts, ignore_index=True)


def rollout_error_table(errors: pd.DataFrame) -> pd.DataFrame:
    """Return mean errors with intervals; `COLUMNS`.

    ``errors``: from `read_rollout_errors`. The baseline belongs to the first model, since the step
    of a model decides its last velocity. A panel `MEAN` with the mean over scenarios follows if
    there are several. Intervals are symmetric in the logarithm of the mean error. Errors are
    skewed, which `degrees_of_freedom` takes into account.
    """
    models = list(dict.fromkeys(errors["model"]))
    scenarios = in_order(set(errors["scenario"]))
    curves = [(model, "model", "error", model) for model in models]
    curves.append((CONSTANT_VELOCITY, "baseline", "baseline", models[0]))
    rows: list[pd.DataFrame] = []
    for name, kind, column, model in curves:
        own = errors[errors["model"] == model]
        means = {
            scenario: _means(own[own["scenario"] == scenario], column)
            for scenario in scenarios
            if (own["scenario"] == scenario).any()
        }
        if len(means) > 1:
            means[MEAN] = _mean_over_scenarios(list(means.values()))
        rows += [
            _rows(values).assign(panel=panel, model=name, kind=kind)
            for panel, values in means.items()
        ]
    table = pd.concat(rows, ignore_index=True)[list(COLUMNS)]
    order = {panel: place for place, panel in enumerate([*scenarios, MEAN])}
    return table.sort_values(
        "panel", key=lambda panels: panels.map(order), kind="stable", ignore_index=True
    )


def _means(rows: pd.DataFrame, column: str) -> pd.DataFrame:
    """Return ``trials``, ``value`` (mean), ``variance`` of the mean and its ``df``, by time."""
    wide = rows.pivot(index="stimulus", columns="seconds", values=column).sort_index()
    values: Array = wide.to_numpy(dtype=np.float64)
    variance = variance_of_mean(values)
    return pd.DataFrame(
        {
            "trials": np.isfinite(values).sum(axis=0),
            "value": np.nanmean(values, axis=0),
            "variance": variance.value,
            "df": variance.df,
        },
        index=wide.columns,
    )


def _mean_over_scenarios(parts: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Return the mean of scenarios at the times that all have."""
    times = sorted(set.intersection(*(set(part.index) for part in parts)))
    aligned = [part.loc[times] for part in parts]
    variance = mean_of(
        [Variance(part["variance"].to_numpy(), part["df"].to_numpy()) for part in aligned]
    )
    return pd.DataFrame(
        {
            "trials": np.sum([part["trials"] for part in aligned], axis=0),
            "value": np.mean([part["value"] for part in aligned], axis=0),
            "variance": variance.value,
            "df": variance.df,
        },
        index=pd.Index(times),
    )


def _rows(means: pd.DataFrame) -> pd.DataFrame:
    variance = Variance(means["variance"].to_numpy(), means["df"].to_numpy())
    bounds = np.array(
        [
            variance.of(k).interval(float(value), scale="positive")
            for k, value in enumerate(means["value"])
        ]
    ).reshape(-1, 2)
    return pd.DataFrame(
        {
            "seconds": means.index.to_numpy(dtype=np.float64),
            "trials": means["trials"].to_numpy(dtype=int),
            "value": means["value"].to_numpy(dtype=np.float64),
            "low": bounds[:, 0],
            "high": bounds[:, 1],
        }
    )
