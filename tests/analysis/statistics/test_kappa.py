"""Kappa against scikit-learn's, and what no answers may break."""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats
from sklearn.metrics import cohen_kappa_score

from physion.analysis.intervals import Bootstrap
from physion.analysis.statistics import agreement as kappa
from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]

answers = st.tuples(st.integers(2, 6), st.integers(1, 25)).flatmap(
    lambda shape: hnp.arrays(np.float64, shape, elements=st.sampled_from([0.0, 1.0]))
)
with_gaps = st.tuples(st.integers(2, 6), st.integers(1, 25)).flatmap(
    lambda shape: hnp.arrays(np.float64, shape, elements=st.sampled_from([0.0, 1.0, np.nan]))
)


def by_scikit_learn(a: Array, b: Array) -> float:
    shared = ~np.isnan(a) & ~np.isnan(b)
    if not shared.any():
        return float("nan")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return float(cohen_kappa_score(a[shared], b[shared]))


@pytest.mark.slow
@settings(max_examples=40, deadline=None)
@given(with_gaps)
def test_every_pair_is_as_scikit_learn_has_it(values: Array) -> None:
    found = kappa.pairwise_kappa(values)
    for i in range(len(values)):
        for j in range(len(values)):
            expected = by_scikit_learn(values[i], values[j])
            assert found[i, j] == pytest.approx(expected, abs=1e-12, nan_ok=True)


def test_kappa_without_variation() -> None:
    assert np.isnan(kappa.cross_kappa([1, 1, 1], [1, 1, 1])).all()
    # A constant answer and one that varies: no agreement beyond chance, and defined.
    assert kappa.cross_kappa([1, 1, 1, 1], [1, 0, 1, 0]).item() == 0.0
    assert kappa.cross_kappa([1, 0], [0, 1]).item() == -1.0


@settings(deadline=None)
@given(with_gaps)
def test_correlation_matches_scipy(values: Array) -> None:
    found = kappa.pairwise_correlation(values)
    a, b = values[0], values[1]
    shared = ~np.isnan(a) & ~np.isnan(b)
    a, b = a[shared], b[shared]
    if len(a) < 3 or np.ptp(a) == 0 or np.ptp(b) == 0:
        assert np.isnan(found[0, 1])
    else:
        assert found[0, 1] == pytest.approx(stats.pearsonr(a, b).statistic, abs=1e-9)


@settings(max_examples=30, deadline=None)
@given(answers, st.integers(0, 9))
def test_error_consistency_is_the_kappa_of_being_right(values: Array, seed: int) -> None:
    labels = np.random.default_rng(seed).integers(0, 2, values.shape[1]).astype(float)
    found = kappa.pairwise_kappa(kappa.correctness(values, labels))
    right = (values == labels).astype(float)
    expected = by_scikit_learn(right[0], right[1])
    assert found[0, 1] == pytest.approx(expected, abs=1e-12, nan_ok=True)


def test_errors_of_independent_raters_are_not_consistent_however_accurate_they_are() -> None:
    generator = np.random.default_rng(3)
    labels = generator.integers(0, 2, 20_000).astype(float)
    wrong = generator.random((2, 20_000)) < 0.1
    values = np.where(wrong, 1 - labels, labels)
    assert kappa.cross_kappa(*values).item() > 0.6
    assert abs(kappa.pairwise_kappa(kappa.correctness(values, labels))[0, 1]) < 0.03


# --- resampling ------------------------------------------------------------------------------


@settings(max_examples=30, deadline=None)
@given(with_gaps, st.integers(0, 99))
def test_draws_of_stimuli_are_what_repeating_them_gives(values: Array, seed: int) -> None:
    weights = Bootstrap(resamples=3, seed=seed).weights("x", values.shape[1])
    found = kappa.resampled_kappa(values, values[0], weights)
    for row, weight in zip(found, weights, strict=True):
        drawn = np.repeat(values, weight.astype(int), axis=1)
        expected = kappa.cross_kappa(drawn, drawn[0])[:, 0]
        np.testing.assert_allclose(row, expected, atol=1e-12)


@settings(max_examples=30, deadline=None)
@given(with_gaps, st.integers(0, 99))
def test_draws_of_raters_leave_out_pairs_of_one_rater_with_himself(
    values: Array, seed: int
) -> None:
    matrix = kappa.pairwise_kappa(values)
    weights = Bootstrap(resamples=4, seed=seed).weights("people", len(values))
    found = kappa.resampled_mean_of_pairs(matrix, weights)
    for mean, weight in zip(found, weights, strict=True):
        drawn = np.repeat(np.arange(len(values)), weight.astype(int))
        pairs = [
            matrix[i, j]
            for place, i in enumerate(drawn)
            for j in drawn[place + 1 :]
            if i != j and np.isfinite(matrix[i, j])
        ]
        expected = np.mean(pairs) if pairs else np.nan
        assert mean == pytest.approx(expected, abs=1e-12, nan_ok=True)


def test_both_at_once_is_a_draw_of_stimuli_and_then_of_raters() -> None:
    generator = np.random.default_rng(0)
    values = (generator.random((8, 30)) < generator.random(30)).astype(float)
    draws = Bootstrap(resamples=5)
    stimuli, raters = draws.weights("s", 30), draws.weights("r", 8)
    both = kappa.resampled_mean_kappa(values, stimuli, raters)
    for k in range(5):
        drawn = np.repeat(values, stimuli[k].astype(int), axis=1)
        expected = kappa.resampled_mean_of_pairs(kappa.pairwise_kappa(drawn), raters[k : k + 1])
        assert both[k] == pytest.approx(expected[0], abs=1e-12)
    alone = kappa.resampled_mean_kappa(values, None, raters)
    np.testing.assert_array_equal(
        alone, kappa.resampled_mean_of_pairs(kappa.pairwise_kappa(values), raters)
    )
    with pytest.raises(BadInputError, match="draws"):
        kappa.resampled_mean_kappa(values, None, None)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ([[0, 1, 0.5]], "holds 0.5"),
        ([["yes", "no"]], "must be numbers"),
        (np.zeros((2, 2, 2)), "shape"),
    ],
)
def test_answers_that_are_none_are_refused(values: npt.ArrayLike, words: str) -> None:
    with pytest.raises(BadInputError, match=words):
        kappa.pairwise_kappa(values)
    with pytest.raises(BadInputError, match="paired"):
        kappa.cross_kappa([0, 1], [0, 1, 1])
