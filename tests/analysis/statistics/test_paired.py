"""Paired tests of models: by hand, against statsmodels, of the right level and direction."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import numpy.typing as npt
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats
from statsmodels.stats.contingency_tables import mcnemar
from statsmodels.stats.multitest import multipletests

from physion.analysis.intervals import Bootstrap
from physion.analysis.model_tests import PooledStimuli, paired_tests, permutations_of
from physion.analysis.statistics.agreement import pearson
from physion.analysis.statistics.paired import (
    corrected_p,
    mcnemar_exact,
    paired_difference,
    swap_coins,
)
from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]


def r_test(a: Array, b: Array, y: Array, permutations: int = 200, seed: int = 0) -> float:
    """Return p of the difference of two models' r with people."""
    pair = np.stack([a, b])
    strata = np.zeros(len(y), dtype=np.int_)
    return paired_difference(pair, y, strata, permutations=permutations, seed=seed).p


def pooled(p: Array, seed: int = 0, scenarios: int = 2) -> PooledStimuli:
    rng = np.random.default_rng(seed)
    n = p.shape[1]
    label = (rng.random(n) < 0.5).astype(float)
    correct = np.where(np.isnan(p), np.nan, (p > 0.5) == label)
    names = tuple("abcd"[: len(p)])
    scenario = tuple(("collide", "drop")[k % scenarios] for k in range(n))
    return PooledStimuli(names, p, correct, label, rng.random(n), scenario)


# --- corrections --------------------------------------------------------------------------------


def test_corrections_match_statsmodels() -> None:
    rng = np.random.default_rng(0)
    for p in (rng.random(7), rng.integers(1, 5, 12) / 100, np.array([0.03])):
        for method in ("holm", "fdr_bh"):
            expected = multipletests(p, method=method)[1]
            np.testing.assert_allclose(corrected_p(p, method), expected)


def test_corrections_count_the_tests_that_have_a_p() -> None:
    p = [0.01, np.nan, 0.04, 0.03]
    np.testing.assert_allclose(corrected_p(p, "holm"), [0.03, np.nan, 0.06, 0.06])
    np.testing.assert_allclose(corrected_p(p, "fdr_bh"), [0.03, np.nan, 0.04, 0.04])
    with pytest.raises(BadInputError, match="p values"):
        corrected_p([0.2, 1.5], "holm")
    assert corrected_p([], "fdr_bh").shape == (0,)


# --- one pair ------------------------------------------------------------------------------------

bits = st.integers(1, 40).flatmap(
    lambda n: hnp.arrays(np.float64, (2, n), elements=st.sampled_from([0.0, 1.0]))
)


@settings(deadline=None)
@given(bits)
def test_mcnemar_matches_statsmodels(pair: Array) -> None:
    a, b = pair
    found = mcnemar_exact(a, b)
    table = [[np.sum((a == 1) & (b == 1)), found.only_first],
             [found.only_second, np.sum((a == 0) & (b == 0))]]  # fmt: skip
    assert found.only_first - found.only_second == np.sum(a) - np.sum(b)
    expected = mcnemar(table, exact=True).pvalue if found.only_first + found.only_second else 1
    assert found.p == pytest.approx(expected)


def test_permutations_keep_their_level_and_find_a_difference() -> None:
    rng = np.random.default_rng(0)
    p = []
    for seed in range(60):
        y = rng.random(60)
        a, b = (y + rng.normal(0, 0.5, 60) for _ in range(2))
        p.append(r_test(a, b, y, seed=seed))
    assert np.mean(np.array(p) < 0.05) < 0.15 and 0.3 < np.mean(p) < 0.7
    y = rng.random(100)
    near, far = y + rng.normal(0, 0.1, 100), rng.random(100)
    assert r_test(near, far, y, permutations=500) == pytest.approx(1 / 501)
    assert r_test(5 * near + 3, near, y, permutations=100) == 1.0
    assert np.isnan(r_test(np.full(100, 0.5), far, y))


def test_permutations_match_swapping_by_hand() -> None:
    rng = np.random.default_rng(4)
    y, a, b = rng.random((3, 15))
    found = r_test(a, b, y, permutations=50, seed=2)
    coins = swap_coins(50, 15, 2) == 1
    one, two = ((x - x.mean()) / x.std() for x in (a, b))
    differences = [
        pearson(np.where(coin, two, one), y) - pearson(np.where(coin, one, two), y)
        for coin in coins
    ]
    observed = abs(pearson(a, y) - pearson(b, y))
    assert found == (1 + np.sum(np.abs(differences) >= observed - 1e-12)) / 51


def test_the_interval_matches_leaving_out_stimuli_of_both_models_at_once() -> None:
    """Two models whose errors are alike: paired, their difference hardly varies."""
    rng = np.random.default_rng(7)
    y, strata = rng.random(50), np.repeat([0, 1], 25)
    shared = rng.normal(0, 0.5, 50)
    pair = np.stack([y + shared + rng.normal(0, 0.02, 50) for _ in range(2)])
    found = paired_difference(pair, y, strata, permutations=5)
    without = np.array([pearson(*(np.delete(v, k) for v in (pair[0], y)))
                        - pearson(*(np.delete(v, k) for v in (pair[1], y)))
                        for k in range(50)])  # fmt: skip
    parts = [np.sum((own - own.mean()) ** 2) * 24 / 25 for own in np.split(without, 2)]
    assert (found.high + found.low) / 2 == pytest.approx(found.value)
    half = (found.high - found.low) / 2 / np.sqrt(sum(parts))
    assert stats.norm.ppf(0.975) < half < stats.t.ppf(0.975, 15)
    alone = [np.var([pearson(np.delete(p, k), np.delete(y, k)) for k in range(50)]) for p in pair]
    assert sum(parts) < sum(alone) * 50 / 10


# --- tables of all pairs -------------------------------------------------------------------------


def test_pairs_of_models_are_tested_on_what_both_answered() -> None:
    rng = np.random.default_rng(1)
    people, label = rng.random(80), rng.integers(0, 2, 80).astype(float)
    p = np.vstack([people * 0.9 + 0.05, rng.random(80), np.full(80, 0.5), rng.random(80)])
    correct = ((p > 0.5) == label).astype(float)
    p[3] = correct[3] = np.nan
    given = PooledStimuli(tuple("abcd"), p, correct, label, people, ("drop",) * 80)
    table = paired_tests(given, permutations=200).set_index(["first", "second"])
    row = table.loc[("a", "b")]
    assert row["accuracy_difference"] == pytest.approx(np.mean(correct[0]) - np.mean(correct[1]))
    assert row["r_difference"] == pytest.approx(pearson(p[0], people) - pearson(p[1], people))
    assert row["r_difference_low"] > 0 and row["p_r"] < 0.01
    assert (row["only_first"], row["only_second"]) == (
        np.sum(correct[0] > correct[1]), np.sum(correct[0] < correct[1]),
    )  # fmt: skip
    known = table.loc[table["p_accuracy"].notna()]
    for column, method in (("p_accuracy_holm", "holm"), ("p_accuracy_bh", "fdr_bh")):
        expected = multipletests(known["p_accuracy"], method=method)[1]
        np.testing.assert_allclose(known[column], expected)
    assert table.loc[("a", "c"), "reason"].startswith("r: undefined")
    assert table.loc[("a", "d"), "reason"] == "no stimulus that both predict"
    assert table.loc[("a", "d"), ["p_accuracy", "accuracy_difference", "p_r"]].isna().all()
    gaps, lacking = p[:2].copy(), correct[:2].copy()
    gaps[0, :7] = lacking[0, :7] = np.nan
    part = paired_tests(
        PooledStimuli(("a", "b"), gaps, lacking, label, people, given.scenario), permutations=20
    ).iloc[0]
    assert part["stimuli"] == 73
    expected = pearson(p[0, 7:], people[7:]) - pearson(p[1, 7:], people[7:])
    assert part["r_difference"] == pytest.approx(expected)
    assert part["r_difference_low"] < expected < part["r_difference_high"]


def test_more_pairs_have_more_permutations() -> None:
    """Holm multiplies the smallest p, 1 / (1 + permutations), by the number of pairs."""
    assert [permutations_of(pairs) for pairs in (1, 50, 55, 1000)] == [2000, 2000, 2200, 20_000]
    pairs = list(combinations(range(11), 2))
    assert len(pairs) / (1 + permutations_of(len(pairs))) < 0.05
    names = tuple(f"m{k}" for k in range(3))
    given = replace(pooled(np.random.default_rng(0).random((3, 12))), names=names)
    tables = [paired_tests(given, Bootstrap(seed=seed)) for seed in (0, 0, 1)]
    pd.testing.assert_frame_equal(tables[0], tables[1])
    assert not tables[0]["p_r"].equals(tables[2]["p_r"])
