"""Paired tests of RMSD, kappa and r of every two models, in each scenario and over all of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.models.model_tests import PooledStimuli
from physion.analysis.statistics.correlation import correlation_from_sums
from physion.analysis.statistics.jackknife import jackknife
from physion.analysis.statistics.paired import benjamini_hochberg, holm, swap_coins
from physion.analysis.tables.stimuli import POOLED, in_order

Array = npt.NDArray[np.float64]

COLUMNS = ("scenario", "measure", "first", "second", "stimuli", "difference", "low", "high", "p",
           "p_holm", "p_bh")  # fmt: skip


@dataclass(frozen=True)
class SumMeasure:
    """A measure that is a function of sums over stimuli.

    - ``columns``: from P(contact), answers (1 or 0) and P(yes), each (n,), to what is summed
      (n, k);
    - ``value``: from sums (..., k) to the measure (...).
    """

    columns: Callable[[Array, Array, Array], Array]
    value: Callable[[Array], Array]


def _squares(p: Array, answer: Array, people: Array) -> Array:
    return np.stack([np.ones_like(p), (p - people) ** 2], axis=-1)


def _root_mean(sums: Array) -> Array:
    return np.asarray(np.sqrt(np.maximum(sums[..., 1], 0.0) / sums[..., 0]))


def _agreements(p: Array, answer: Array, people: Array) -> Array:
    return np.stack([np.ones_like(p), answer, people, answer * people], axis=-1)


def _kappa(sums: Array) -> Array:
    """Return (A - C) / (1 - C), as `metrics.average_person.kappa_from_averages`."""
    answer, people, both = (sums[..., k] / sums[..., 0] for k in (1, 2, 3))
    expected = answer * people + (1 - answer) * (1 - people)
    with np.errstate(divide="ignore", invalid="ignore"):
        kappa = (1 - answer - people + 2 * both - expected) / (1 - expected)
    return np.where(1 - expected > 1e-12, kappa, np.nan)


def _products(p: Array, answer: Array, people: Array) -> Array:
    # Standardised, so that two models whose values spread differently can be swapped.
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (p - p.mean()) / p.std()
    y = people - people.mean()
    return np.stack([np.ones_like(p), x, y, x * x, y * y, x * y], axis=-1)


def _pearson(sums: Array) -> Array:
    return correlation_from_sums(*(sums[..., k] for k in range(6)))


MEASURES: Mapping[str, SumMeasure] = {
    "rmsd": SumMeasure(_squares, _root_mean),
    "kappa_from_averages": SumMeasure(_agreements, _kappa),
    "r": SumMeasure(_products, _pearson),
}
"""What is compared, by the name of its metric."""


def paired_measures(
    pooled: PooledStimuli, level: float = 0.95, permutations: int = 2000, seed: int = 0
) -> pd.DataFrame:
    """Test the differences of every two models in `MEASURES`.

    Parameters
    ----------
    pooled
        Models and people on the stimuli of all scenarios.
    level
        Level of the intervals.
    permutations, seed
        Number of permutations, and the seed of the coins that decide who is swapped.

    Returns
    -------
    table
        `COLUMNS`: one row a scenario (and `POOLED`), measure and pair on the stimuli that both
        predict: ``difference`` (first less second) with its jackknife interval over stimuli, the
        two-sided ``p`` of the permutation test, and ``p`` corrected over the pairs of the same
        scenario and measure. Empty without people or with one model.

    Notes
    -----
    Under the null hypothesis the two models are exchangeable, so for every stimulus they are
    swapped with probability 1/2. p = (1 + count of |difference| as large) / (1 + permutations).
    """
    scenarios = in_order(set(pooled.scenario))
    groups = [*scenarios, POOLED] if len(scenarios) > 1 else scenarios
    strata = np.array([scenarios.index(name) for name in pooled.scenario])
    parts = []
    for group in groups:
        members = np.ones(len(strata), bool)
        if group != POOLED:
            members = strata == scenarios.index(group)
        members &= np.isfinite(pooled.p_yes)
        for measure in MEASURES:
            rows = [
                _pair(pooled, i, j, members, strata, measure, level, permutations, seed)
                for i, j in combinations(range(len(pooled.names)), 2)
            ]
            table = pd.DataFrame(rows, columns=list(COLUMNS[2:9]))
            table = table.assign(p_holm=holm(table["p"]), p_bh=benjamini_hochberg(table["p"]))
            parts.append(table.assign(scenario=group, measure=measure))
    table = pd.concat(parts, ignore_index=True)[list(COLUMNS)]
    return table[table["difference"].notna()].reset_index(drop=True)


def _pair(
    pooled: PooledStimuli,
    i: int,
    j: int,
    members: npt.NDArray[np.bool_],
    strata: npt.NDArray[np.int_],
    name: str,
    level: float,
    permutations: int,
    seed: int,
) -> tuple[str, str, int, float, float, float, float]:
    shared = members & np.isfinite(pooled.p_contact[i]) & np.isfinite(pooled.p_contact[j])
    n, nan = int(shared.sum()), float("nan")
    names = pooled.names[i], pooled.names[j]
    if n < 3:
        return *names, n, nan, nan, nan, nan
    measure, label, people = MEASURES[name], pooled.label[shared], pooled.p_yes[shared]
    first, second = (
        measure.columns(
            pooled.p_contact[k, shared],
            np.where(pooled.correct[k, shared] == 1, label, 1 - label),
            people,
        )
        for k in (i, j)
    )
    totals = first.sum(axis=0), second.sum(axis=0)
    difference = float(measure.value(totals[0]) - measure.value(totals[1]))
    if not np.isfinite(difference):
        return *names, n, nan, nan, nan, nan
    without = measure.value(totals[0] - first) - measure.value(totals[1] - second)
    low, high = jackknife(without, strata[shared]).interval(difference, level)
    change = swap_coins(permutations, n, seed) @ (second - first)
    swapped = measure.value(totals[0] + change) - measure.value(totals[1] - change)
    as_large = np.sum(np.abs(swapped) >= abs(difference) - 1e-12)
    return *names, n, difference, low, high, float((1 + as_large) / (1 + permutations))
