"""Paired tests of differences between models, and corrections for multiple comparisons."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations
from typing import Literal

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from physion.analysis.intervals import Bootstrap, jackknife
from physion.analysis.statistics.agreement import (
    correlate_resampled,
    correlation_from_sums,
    pearson,
)
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


def r_differences(
    first: npt.ArrayLike, second: npt.ArrayLike, people: npt.ArrayLike, weights: npt.ArrayLike
) -> Array:
    """Return r(first, people) - r(second, people) for each row of weights of stimuli, (rows,)."""
    pair = np.stack([np.asarray(first, np.float64), np.asarray(second, np.float64)])
    drawn = np.asarray(weights, dtype=np.float64)
    p_yes = np.broadcast_to(np.asarray(people, dtype=np.float64), drawn.shape)
    r = correlate_resampled(pair, p_yes, drawn)
    return np.asarray(r[:, 0] - r[:, 1])


def r_permutation_p(
    first: npt.ArrayLike,
    second: npt.ArrayLike,
    people: npt.ArrayLike,
    permutations: int = 2000,
    seed: int = 0,
) -> float:
    """Return the two-sided p of the difference of two models' r with people, by permutation.

    Under the null hypothesis the standardised models are exchangeable, since r does not depend on
    shift and scale; for every stimulus the two are swapped with probability 1/2. p = (1 + count of
    |difference| as large) / (1 + permutations). NaN if an r is undefined.
    """
    a, b = np.asarray(first, np.float64), np.asarray(second, np.float64)
    y = np.asarray(people, np.float64)
    known = np.isfinite(a) & np.isfinite(b) & np.isfinite(y)
    a, b, y = a[known], b[known], y[known]
    observed = pearson(a, y) - pearson(b, y)
    if not np.isfinite(observed):
        return float("nan")
    a, b = (a - a.mean()) / a.std(), (b - b.mean()) / b.std()
    swap = swap_coins(permutations, len(a), seed)
    r = _swapped_r(a, b, y - y.mean(), swap) - _swapped_r(b, a, y - y.mean(), swap)
    as_large = np.sum(np.abs(r) >= abs(observed) - 1e-12)
    return float((1 + as_large) / (1 + permutations))


@lru_cache(maxsize=2)
def swap_coins(permutations: int, n: int, seed: int) -> Array:
    """Return 0 or 1 for each permutation and stimulus; cached, since all pairs of models share
    them.
    """
    rng = generator("swap", seed, n)
    coins = (rng.random((permutations, n)) < 0.5).astype(np.float64)
    coins.flags.writeable = False
    return coins


def _swapped_r(a: Array, b: Array, y: Array, swap: Array) -> Array:
    """Return r with ``y`` of ``a`` with the values of ``b`` at the stimuli of ``swap``."""
    change = swap @ np.stack([b - a, b * b - a * a, (b - a) * y], axis=1)
    n, ones = float(len(a)), np.ones(len(swap))
    return correlation_from_sums(
        n * ones, a.sum() + change[:, 0], y.sum() * ones,
        (a * a).sum() + change[:, 1], (y * y).sum() * ones, (a * y).sum() + change[:, 2],
    )  # fmt: skip


# --- corrections for many comparisons -----------------------------------------------------------


def corrected_p(p: npt.ArrayLike, method: Literal["holm", "fdr_bh"]) -> Array:
    """Return p values corrected for many tests; NaN stays NaN and is not counted as a test.

    ``holm`` is Holm's step-down method, which controls the family-wise error; ``fdr_bh`` the method
    of Benjamini and Hochberg, which controls the false discovery rate.
    """
    from statsmodels.stats.multitest import multipletests  # half a second to import

    values = np.asarray(p, dtype=np.float64)
    known = np.isfinite(values)
    if ((values[known] < 0) | (values[known] > 1)).any():
        raise BadInputError("p values must lie in 0..1")
    adjusted = np.full(values.shape, np.nan)
    if known.any():
        adjusted[known] = multipletests(values[known], method=method)[1]
    return adjusted


# --- the table of all pairs ---------------------------------------------------------------------


def compare_models(
    names: list[str],
    correct: Array,
    p_contact: Array,
    people: Array,
    bootstrap: Bootstrap | None = None,
    *,
    strata: Sequence[str] | None = None,
    permutations: int = 2000,
) -> pd.DataFrame:
    """Test every two models on the same stimuli; one row per pair.

    Parameters
    ----------
    names
        Names of the m models.
    correct, p_contact
        (m, s), NaN for stimuli that a model lacks. A pair is compared on the stimuli that both
        answered.
    people
        (s,): fraction of people who say yes.
    bootstrap
        Level of the intervals, and the seed of the permutations.
    strata
        (s,): scenario of each stimulus; every scenario keeps its number of stimuli.
    permutations
        Permutations of the test of differences in r.

    Returns
    -------
    ``first``, ``second``, ``stimuli``, ``accuracy_difference`` (first - second), ``only_first``,
    ``only_second``, ``p_accuracy`` (McNemar, exact), ``r_difference`` with ``_low``, ``_high``
    (jackknife over stimuli), ``p_r`` (permutations), and of both p the corrected ``_holm`` and
    ``_bh`` over all pairs of this table, ``reason``.
    """
    draws = bootstrap or Bootstrap()
    groups = pd.factorize(np.asarray(["pooled"] * len(people) if strata is None else strata))[0]
    without = 1 - np.eye(len(people))
    together = correlate_resampled(p_contact, np.broadcast_to(people, without.shape), without)
    records = []
    for i, j in combinations(range(len(names)), 2):
        shared = np.isfinite(correct[i]) & np.isfinite(correct[j])
        counts = mcnemar_exact(correct[i], correct[j])
        both = shared & np.isfinite(people)
        x, z = np.where(both, p_contact[i], np.nan), np.where(both, p_contact[j], np.nan)
        difference = pearson(x[both], people[both]) - pearson(z[both], people[both])
        if (np.isfinite(p_contact[i]) == np.isfinite(p_contact[j])).all():
            drawn = together[:, i] - together[:, j]
        else:
            drawn = r_differences(x, z, people, without)
        low, high = jackknife(drawn, groups, both).interval(difference, draws.level)
        records.append(
            {
                "first": names[i],
                "second": names[j],
                "stimuli": int(shared.sum()),
                "accuracy_difference": float(np.mean(correct[i, shared] - correct[j, shared]))
                if shared.any()
                else np.nan,
                "only_first": counts.only_first,
                "only_second": counts.only_second,
                "p_accuracy": counts.p if shared.any() else np.nan,
                "r_difference": difference,
                "r_difference_low": low,
                "r_difference_high": high,
                "p_r": r_permutation_p(x, z, people, permutations, draws.seed),
                "reason": _why(shared, difference),
            }
        )
    columns = ["first", "second", "stimuli", "accuracy_difference", "only_first", "only_second"]
    columns += ["p_accuracy", "r_difference", "r_difference_low", "r_difference_high", "p_r"]
    table = pd.DataFrame(records, columns=[*columns, "reason"])
    for p in ("p_accuracy", "p_r"):
        table[f"{p}_holm"] = corrected_p(table[p], "holm")
        table[f"{p}_bh"] = corrected_p(table[p], "fdr_bh")
    return table


def _why(shared: npt.NDArray[np.bool_], difference: float) -> str:
    if not shared.any():
        return "no stimulus that both predict"
    return "" if np.isfinite(difference) else "r: undefined for one of the two"
