"""Supplementary figures of the paper from its released tables, and how kappa follows accuracy."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.people.difficulty import below_chance_level
from physion.analysis.published.panels import panel_a, panel_c
from physion.analysis.published.tables import PARTICLES, PublishedTables
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.tables.stimuli import MEAN

Array = npt.NDArray[np.float64]

S3_MODEL = "DPI"
"""The model that figure S3 sets against people."""

NOT_MADE = {
    "Panel B": "r with the average person needs a model's prediction for each stimulus, which the "
    "released tables do not hold",
    "S1, examples": "the movies of the stimuli below chance are no part of the released tables",
    "S2": "r within hard, chance and easy stimuli needs a model's prediction for each stimulus, "
    "and single answers of people for their halves",
    "S4": "accuracy of DPI and people by stimulus needs a prediction of DPI for each stimulus",
    "S5": "models trained on one scenario and tested on another: the released rows of training "
    "“only” are tested on the scenario of their training alone",
}
"""Figures that the released tables do not determine, and the reason."""


def figure_s1(tables: PublishedTables) -> pd.DataFrame:
    """Return the accuracy of people by stimulus: the top of figure S1, for all eight scenarios.

    Columns: see `difficulty.below_chance_level`.
    """
    return below_chance_level(tables.stimuli)


def figure_s3(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return the accuracy of `S3_MODEL` and of people by scenario, and the mean over scenarios.

    Columns: ``model``, ``scenario``, ``accuracy``, ``people``, ``difference`` (model - people). The
    model is trained on all scenarios, its readout is observed+simulated. The model is tested on all
    test stimuli, also on those that people did not see.
    """
    rows = panel_a(tables, bootstrap)
    rows = rows[rows["model"] == S3_MODEL].reset_index(drop=True)
    table = rows[["model", "scenario", "accuracy", "people"]]
    return table.assign(difference=table["accuracy"] - table["people"])


def accuracy_and_kappa(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return how strongly kappa with participants follows accuracy, over the cells of panels A, C.

    Columns: ``over`` (what the points are), ``models``, ``points``, ``r`` (Pearson) with
    ``r_low`` and ``r_high`` (percentile bootstrap that draws models with all of their scenarios).
    The rows: means of all models, and of vision models alone; cells of model and scenario; and r
    within a scenario, averaged over scenarios, which no difference between scenarios can cause.
    """
    draws = bootstrap or Bootstrap()
    keys = ["model", "scenario"]
    cells = panel_a(tables, draws)[[*keys, "accuracy"]].merge(
        panel_c(tables, draws)[[*keys, "kappa"]], on=keys
    )
    accuracy, kappa = (
        cells.pivot(index="model", columns="scenario", values=name)
        .drop(columns=MEAN)
        .to_numpy(dtype=np.float64)
        for name in ("accuracy", "kappa")
    )
    # The rows of a pivot are sorted by name.
    models = sorted(cells["model"].unique())
    vision = np.array([name not in PARTICLES for name in models])
    records = []
    for over, x, y in (
        ("means of models over scenarios", accuracy.mean(axis=1), kappa.mean(axis=1)),
        ("the same, vision models alone", accuracy[vision].mean(axis=1),
         kappa[vision].mean(axis=1)),
        ("cells of model and scenario", accuracy, kappa),
    ):  # fmt: skip
        columns = x.reshape(len(x), -1), y.reshape(len(y), -1)
        records.append(_correlation(over, *columns, pooled=True, draws=draws))
    within = "models within a scenario, mean over scenarios"
    records.append(_correlation(within, accuracy, kappa, pooled=False, draws=draws))
    return pd.DataFrame(records)


def _correlation(
    over: str, x: Array, y: Array, *, pooled: bool, draws: Bootstrap
) -> dict[str, object]:
    """Correlate x and y (models, scenarios): all cells together, or by column and then averaged."""
    models, scenarios = x.shape
    weights = draws.weights(over, models)

    def correlate(drawn: Array) -> Array:
        groups = [slice(None)] if pooled else [slice(k, k + 1) for k in range(scenarios)]
        return np.asarray(np.mean([_weighted_r(x[:, g], y[:, g], drawn) for g in groups], axis=0))

    low, high = draws.interval(correlate(weights))
    return {"over": over, "models": models, "points": x.size,
            "r": float(correlate(np.ones((1, models)))[0]), "r_low": low,
            "r_high": high}  # fmt: skip


def _weighted_r(x: Array, y: Array, weights: Array) -> Array:
    """Return Pearson's r over all cells (models, k) for each row of weights (b, models), (b,)."""
    total = weights.sum(axis=1) * x.shape[1]
    mean_x, mean_y = (weights @ values.sum(axis=1) / total for values in (x, y))
    xy, xx, yy = (
        weights @ (one * other).sum(axis=1) / total for one, other in ((x, y), (x, x), (y, y))
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        spread = np.sqrt((xx - mean_x**2) * (yy - mean_y**2))
        return np.where(spread > 0, (xy - mean_x * mean_y) / spread, np.nan)
