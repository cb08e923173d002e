"""Paired tests of differences between two models, and corrections for many tests.

`mcnemar_exact` compares correct answers; `paired_difference` r with people, which is a function of
sums over stimuli, so that leaving stimuli out and swapping models need sums only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy import stats

from physion.analysis.intervals import jackknife
from physion.analysis.statistics.agreement import CONSTANT, FEWEST, correlation_from_sums
from physion.core.errors import BadInputError
from physion.core.seeds import generator

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class McNemar:
    """Result of McNemar's test.

    ``only_first``: stimuli that only the first model answers correctly; ``only_second``; ``p``:
    two-sided.
    """

    only_first: int
    only_second: int
    p: float


def mcnemar_exact(first: npt.ArrayLike, second: npt.ArrayLike) -> McNemar:
    """Test whether two models are right equally often: McNemar's exact test of paired answers.

    ``first``, ``second``: 1 right, 0 wrong, NaN not answered; stimuli that one of them lacks are
    left out. If they never differ, p is 1.
    """
    a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
    only_a, only_b = int(np.sum((a == 1) & (b == 0))), int(np.sum((a == 0) & (b == 1)))
    if not only_a + only_b:
        return McNemar(0, 0, 1.0)
    p = float(stats.binomtest(only_a, only_a + only_b, 0.5).pvalue)
    return McNemar(only_a, only_b, p)


def _products(p: Array, people: Array) -> Array:
    # Standardised, so that two models whose values spread differently can be swapped.
    x = (p - p.mean()) / (p.std() if p.std() >= CONSTANT else np.nan)
    y = people - people.mean()
    return np.stack([np.ones_like(p), x, y, x * x, y * y, x * y], axis=-1)


def _pearson(sums: Array) -> Array:
    return correlation_from_sums(*(sums[..., k] for k in range(6)))


class Difference(NamedTuple):
    """A difference of two models (first less second) with its interval and two-sided p."""

    value: float = float("nan")
    low: float = float("nan")
    high: float = float("nan")
    p: float = float("nan")


def paired_difference(
    p_contact: Array,
    people: Array,
    strata: npt.NDArray[np.int_],
    *,
    permutations: int = 2000,
    seed: int = 0,
) -> Difference:
    """Test the difference of two models in r with people on n stimuli.

    Parameters
    ----------
    p_contact
        (2, n): P(contact) of the two models.
    people
        (n,): fraction of people who say yes.
    strata
        (n,): scenario of each stimulus, for the jackknife interval over stimuli.
    permutations, seed
        Number of permutations, and the seed of the coins that decide who is swapped.

    Returns
    -------
    difference
        NaN if r is undefined for one of the two, or for fewer than three stimuli.

    Notes
    -----
    Under the null hypothesis the standardised values of the two models are exchangeable (r does not
    depend on shift and scale), so for every stimulus they are swapped with probability 1/2. p = (1
    + count of |difference| as large) / (1 + permutations).
    """
    n = len(people)
    if n < FEWEST:
        return Difference()
    first, second = (_products(p, people) for p in p_contact)
    totals = first.sum(axis=0), second.sum(axis=0)
    difference = float(_pearson(totals[0]) - _pearson(totals[1]))
    if not np.isfinite(difference):
        return Difference()
    without = _pearson(totals[0] - first) - _pearson(totals[1] - second)
    low, high = jackknife(without, strata).interval(difference)
    change = swap_coins(permutations, n, seed) @ (second - first)
    swapped = _pearson(totals[0] + change) - _pearson(totals[1] - change)
    as_large = np.sum(np.abs(swapped) >= abs(difference) - 1e-12)
    return Difference(difference, low, high, float((1 + as_large) / (1 + permutations)))


@lru_cache(maxsize=2)
def swap_coins(permutations: int, n: int, seed: int) -> Array:
    """Return 0 or 1 for each permutation and stimulus; cached, since all pairs of models share
    them.
    """
    rng = generator("swap", seed, n)
    coins = (rng.random((permutations, n)) < 0.5).astype(np.float64)
    coins.flags.writeable = False
    return coins


def corrected_p(p: npt.ArrayLike, method: Literal["holm", "fdr_bh"]) -> Array:
    """Return p values corrected for many tests; NaN stays NaN and is not counted as a test.

    ``holm`` is Holm's step-down method, which controls the family-wise error; ``fdr_bh`` is
    the method of Benjamini and Hochberg, which controls the false discovery rate. Holm's is not
    statsmodels' `multipletests`, which collects garbage at every call: a second in a large process.
    """
    values = np.asarray(p, dtype=np.float64)
    known = np.isfinite(values)
    if ((values[known] < 0) | (values[known] > 1)).any():
        raise BadInputError("p values must lie in 0..1")
    tests = values[known]
    if method == "fdr_bh":
        corrected = stats.false_discovery_control(tests) if len(tests) else tests
    else:
        order = np.argsort(tests)
        corrected = np.empty_like(tests)
        steps = tests[order] * np.arange(len(tests), 0, -1)
        corrected[order] = np.minimum(np.maximum.accumulate(steps), 1.0)
    adjusted = np.full(values.shape, np.nan)
    adjusted[known] = corrected
    return adjusted
