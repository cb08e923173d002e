"""Published table of model accuracies by scenario, next to the setting that readers expect.

The table of the paper's supplement (S1) names no protocol. Each of its 88 values is the mean over
all rows that the released results have for a model and a scenario: every readout, every training
protocol, every run. It thus mixes *detection* (readout *full*, which sees the outcome) with
*prediction*. A reader expects the paper's main setting: trained on *all* scenarios, readout
*observed+simulated*.
"""

from __future__ import annotations

from fractions import Fraction
from math import lcm

import numpy as np
import pandas as pd
from scipy import stats

from physion.analysis.published.tables import (
    OBSERVED_AGAIN,
    PublishedTables,
    in_paper_order,
)
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.core.names import SCENARIOS

EXPECTED = {"training": "all", "readout": "observed+simulated"}
"""The setting that the paper's main figure shows."""

MOST_STIMULI = 400
"""No scenario of the study was tested on more."""


def accuracy_table(tables: PublishedTables, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return the published mean of each model and scenario and the value that a reader expects.

    Columns: ``model``, ``scenario``; ``published`` with ``published_low``, ``published_high``
    (bootstrap over the rows that it averages: variation with other protocols and seeds, not with
    other stimuli) and ``paper_low``, ``paper_high`` (`paper_intervals`), ``rows`` (number of rows),
    ``without_copies`` (the mean with *observed* once);
    ``expected`` with ``expected_low``, ``expected_high`` (Wilson's 95 % interval: other stimuli of
    the kind), ``runs`` (seeds averaged in it), ``stimuli`` (tested; see `count_tested`),
    ``difference`` (expected - published).
    """
    draws = bootstrap or Bootstrap()
    level = draws.level
    counts = count_tested(tables.runs)
    once = tables.distinct
    by_paper = paper_intervals(tables, draws)
    records = []
    for (model, scenario), rows in tables.runs.groupby(["model", "scenario"], sort=False):
        values = rows["accuracy"].to_numpy(dtype=np.float64)
        weights = draws.weights(f"{model} {scenario}", len(values))
        low, high = draws.interval(weights @ values / len(values))
        own = once.loc[once.index.intersection(rows.index)]
        cell = own[(own[list(EXPECTED)] == pd.Series(EXPECTED)).all(axis=1)]["accuracy"]
        expected = float(cell.mean()) if len(cell) else float("nan")
        stimuli = counts[(model, scenario)]
        expected_low, expected_high = wilson(expected, stimuli, level)
        records.append(
            {
                "model": model,
                "scenario": scenario,
                "published": float(values.mean()),
                "published_low": low,
                "published_high": high,
                "paper_low": by_paper[(model, scenario)][0],
                "paper_high": by_paper[(model, scenario)][1],
                "rows": len(rows),
                "without_copies": float(own["accuracy"].mean()),
                "expected": expected,
                "expected_low": expected_low,
                "expected_high": expected_high,
                "runs": len(cell),
                "stimuli": stimuli,
                "difference": expected - float(values.mean()),
            }
        )
    return in_paper_order(pd.DataFrame(records), ["model", "scenario"])


def paper_intervals(
    tables: PublishedTables, bootstrap: Bootstrap | None = None
) -> dict[tuple[str, str], tuple[float, float]]:
    """Return the interval of each published value by the paper's way, by (model, scenario).

    The released notebook calls ``tidyboot_mean`` on the table grouped by model and scenario, which
    resamples the rows of the whole table, ungrouped, with one row of people a scenario, and then
    averages each group. So the number of rows of a value differs between draws, and the intervals
    are wider than those of drawing its own rows. A draw without a row of the value is left out.
    """
    draws = bootstrap or Bootstrap()
    runs = tables.runs
    weights = draws.weights("published table", len(runs) + len(tables.people))[:, : len(runs)]
    accuracy = runs["accuracy"].to_numpy(dtype=np.float64)
    found = {}
    for (model, scenario), positions in runs.groupby(["model", "scenario"]).indices.items():
        drawn = weights[:, positions]
        with np.errstate(divide="ignore", invalid="ignore"):
            means = drawn @ accuracy[positions] / drawn.sum(axis=1)
        found[(str(model), str(scenario))] = draws.interval(means)
    return found


def grid(table: pd.DataFrame, column: str) -> pd.DataFrame:
    """Return one column of `accuracy_table` as models by scenarios, with their mean last."""
    wide = table.pivot(index="model", columns="scenario", values=column)
    wide = wide.reindex(index=list(dict.fromkeys(table["model"])))
    wide = wide[[name for name in SCENARIOS if name in wide]]
    return wide.assign(mean=wide.mean(axis=1, skipna=False)).reset_index().rename_axis(columns=None)


def count_tested(runs: pd.DataFrame) -> dict[tuple[str, str], int]:
    """Return how many stimuli each model was tested on, by (model, scenario).

    The released tables do not contain it; the accuracies are fractions, so the number follows from
    their denominators. Models see all test trials of a scenario, including those that no person
    saw.
    """
    largest: dict[tuple[str, str], int] = {}
    common = dict.fromkeys(runs["scenario"], 1)
    for (model, scenario), rows in runs.groupby(["model", "scenario"], sort=False):
        found = [_denominator(value) for value in rows["accuracy"]]
        largest[(model, scenario)] = max(found)
        together = lcm(*found)
        if together <= MOST_STIMULI:
            common[scenario] = max(common[scenario], together)
    return {
        (model, scenario): common[scenario] if common[scenario] % n == 0 else n
        for (model, scenario), n in largest.items()
    }


def _denominator(fraction: float) -> int:
    return Fraction(fraction).limit_denominator(MOST_STIMULI).denominator


def wilson(fraction: float, n: float, level: float = 0.95) -> tuple[float, float]:
    """Return Wilson's interval of a fraction of ``n`` independent trials; NaN, NaN if undefined."""
    if not (np.isfinite(fraction) and n > 0):
        return float("nan"), float("nan")
    z = float(stats.norm.ppf(0.5 + level / 2))
    centre = fraction + z * z / (2 * n)
    half = z * float(np.sqrt(fraction * (1 - fraction) / n + (z / (2 * n)) ** 2))
    return (centre - half) / (1 + z * z / n), (centre + half) / (1 + z * z / n)


def copies_of_observed(tables: PublishedTables) -> tuple[int, int]:
    """Count the rows with the second copy of *observed*: those equal to the first one, and all."""
    cell = ["model", "scenario", "training", "seed", "file"]
    runs = tables.runs
    again = runs[runs["readout"] == OBSERVED_AGAIN].set_index(cell)["accuracy"]
    first = runs[runs["readout"] == "observed"].set_index(cell)["accuracy"]
    return int((again == first.reindex(again.index)).sum()), len(again)


def describe_averages(tables: PublishedTables) -> str:
    """Return what a published value averages, counted in the tables at hand, as text."""
    equal, copies = copies_of_observed(tables)
    counts = tables.runs.groupby("model")["accuracy"].size() / tables.runs["scenario"].nunique()
    per_model = ", ".join(f"{model} {n:g}" for model, n in counts[counts > 3].items())
    few = ", ".join(str(model) for model in counts[counts <= 3].index)
    words = (
        "Each published value is the plain mean of all released rows of a model and a scenario: "
        "every readout (full, observed+simulated, observed), every training protocol (all, "
        "all-but, only) and every run. Readout full sees the whole movie, so the published values "
        f"mix detection into prediction. Rows averaged by model: {per_model}; {few} have the three "
        "training protocols alone. "
    )
    if copies:
        twice = " and ".join(
            tables.runs[tables.runs["readout"] == OBSERVED_AGAIN]["model"].unique()
        )
        words += (
            f"For {twice} observed counts twice: their readout D repeats C in {equal} of {copies} "
            "rows. "
        )
    files = tables.runs.groupby(["model", "seed", "scenario"])["file"].nunique()
    for (model, seed), number in files.groupby(["model", "seed"]).max().items():
        if number > 1:
            words += f"Seed {seed} of {model} stands in {number} result files, with other numbers. "
    return words + (
        "Beside it stands the cell that a reader expects: trained on all scenarios, readout "
        "observed+simulated, the mean of the seeds."
    )
