"""Panels of the paper's main comparison as tables: accuracy, kappa, readouts, trainings.

Panels A to C show training *all* and readout *observed+simulated*; panels D and E vary the readout
and the training. All show the first seed of SVG and RPIN, as the released code selects. The
intervals of the panels are bootstraps over the eight scenario values. Panel B (r with the average
person) needs the predictions for single stimuli, which the released tables do not contain.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from physion.analysis.models.zones import released_zone
from physion.analysis.published.cells import EXPECTED
from physion.analysis.published.tables import (
    PARTICLES,
    TRAININGS,
    PublishedTables,
    in_paper_order,
)
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.tables.stimuli import MEAN

READOUT_ORDER = ("observed", "observed+simulated", "full")

SELECTION = (
    "All panels show seed 0 alone of SVG and RPIN, as the released code selects. Panels A and C: "
    "training all, readout observed+simulated. Panel D: training all; particle models have one "
    "readout. Panel E: readout observed+simulated. Intervals of a mean are a "
    "bootstrap over the scenario values, seeded (the released code drew without a seed). “Zone” "
    "in a scenario's row is the middle 95 % of participants (accuracy) or of pairs of them "
    "(kappa); in the row of the mean it is the paper's grey band, a bootstrap over the scenario "
    "means, which does not say how participants differ. Kappa of a model is the median over "
    "participants, though the paper speaks of a mean. Panel B is missing: r with the average "
    "person cannot be had from the released tables, which hold no prediction for a single stimulus."
)


def panel_a(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return the accuracy of each model and of people by scenario; see `_measure`."""
    return _measure(tables, "accuracy", bootstrap or Bootstrap())


def panel_c(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return Cohen's kappa of each model with participants, median over them; see `_measure`."""
    return _measure(tables, "kappa", bootstrap or Bootstrap())


def panel_d(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return accuracy by readout, trained on all scenarios, averaged over scenarios.

    Columns: ``model``, ``readout``, ``scenarios`` (averaged), ``accuracy`` with ``low`` and
    ``high``.
    """
    runs = tables.first_seeds
    rows = runs[(runs["training"] == EXPECTED["training"]) & ~runs["model"].isin(PARTICLES)]
    return _by(rows, "readout", READOUT_ORDER, bootstrap or Bootstrap())


def panel_e(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return accuracy by training protocol, readout observed+simulated; columns as `panel_d`, with
    ``training`` instead of ``readout``.
    """
    runs = tables.first_seeds
    rows = runs[runs["readout"] == EXPECTED["readout"]]
    return _by(rows, "training", tuple(TRAININGS.values()), bootstrap or Bootstrap())


def _measure(tables: PublishedTables, measure: str, draws: Bootstrap) -> pd.DataFrame:
    """Return one row a model and scenario, then its mean over scenarios.

    Columns: ``model``, ``scenario``, the measure with ``low`` and ``high`` (of the mean: bootstrap
    over scenarios; of a kappa: percentiles over participants; else NaN), ``people`` (their value)
    with ``zone_low``, ``zone_high``, and ``in_zone`` (whether the model is within; None without a
    zone).
    """
    runs = tables.first_seeds
    chosen = runs[(runs[list(EXPECTED)] == pd.Series(EXPECTED)).all(axis=1)]
    own = chosen[["model", "scenario", measure]].copy()
    if measure == "kappa":
        own[["low", "high"]] = chosen[["kappa_low", "kappa_high"]]
    else:
        own[["low", "high"]] = np.nan
    zone = ["zone_low", "zone_high"] if measure == "accuracy" else ["kappa_low", "kappa_high"]
    people = tables.people[["scenario", measure, *zone]]
    people.columns = pd.Index(["scenario", "people", "zone_low", "zone_high"])
    mean, low, high = released_zone(people["people"].to_numpy(dtype=np.float64), draws)
    means = [
        {"model": model, "scenario": MEAN, **_mean(rows[measure], measure, draws),
         "people": mean, "zone_low": low, "zone_high": high}
        for model, rows in own.groupby("model", sort=False)
    ]  # fmt: skip
    table = in_paper_order(
        pd.concat([own.merge(people, on="scenario"), pd.DataFrame(means)], ignore_index=True),
        ["model", "scenario"],
    )
    inside = table[measure].between(table["zone_low"], table["zone_high"])
    return table.assign(in_zone=inside)


def _by(rows: pd.DataFrame, what: str, order: Sequence[str], draws: Bootstrap) -> pd.DataFrame:
    records = []
    for (model, value), cells in rows.groupby(["model", what], sort=False):
        record: dict[str, object] = {"model": model, what: value, "scenarios": len(cells)}
        record |= _mean(cells["accuracy"], "accuracy", draws)
        records.append(record)
    table = pd.DataFrame(records)
    table = table.assign(place=table[what].map({name: at for at, name in enumerate(order)}))
    return in_paper_order(table, ["model", "place"]).drop(columns="place")


def _mean(values: pd.Series, measure: str, draws: Bootstrap) -> dict[str, float]:
    array = values.to_numpy(dtype=np.float64)
    weights = draws.weights("scenarios", len(array))
    low, high = draws.interval(weights @ array / len(array))
    return {measure: float(array.mean()), "low": low, "high": high}
