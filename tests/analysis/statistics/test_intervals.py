"""Intervals: jackknife against formulas, bootstrap repeatable and of the right width."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.stats import binomtest

from physion.analysis.intervals import (
    Bootstrap,
    Scale,
    Variance,
    delete_one,
    jackknife,
    mean_of,
    second_order,
    variance_of_mean,
    wilson,
)
from physion.core.errors import BadInputError

values_of_units = hnp.arrays(
    np.float64, st.integers(3, 30), elements=st.integers(0, 1000).map(lambda k: k / 1e3)
)


@given(values_of_units)
def test_the_variance_of_a_mean_matches_the_textbook(values: np.ndarray) -> None:
    without = (1 - np.eye(len(values))) @ values / (len(values) - 1)
    expected = np.var(values, ddof=1) / len(values)
    for found in (jackknife(without), variance_of_mean(values)):
        assert found.value == pytest.approx(expected, abs=1e-12)
        assert 1 - 1e-9 <= found.df <= len(values) - 1 + 1e-9
    if expected > 1e-6:
        assert jackknife(without).df == pytest.approx(variance_of_mean(values).df, rel=1e-6)
        assert jackknife(without, counts=True).df == pytest.approx(len(values) - 1)
        assert variance_of_mean(values, counts=True).df == pytest.approx(len(values) - 1)


def test_degrees_of_freedom_match_a_chi_square_as_variable() -> None:
    """Over many samples, the variance of the estimated variance is 2 / df of its squared mean."""
    rng = np.random.default_rng(6)
    for values, most in ((rng.normal(size=(40, 4000)), 39), (rng.uniform(size=(40, 4000)), 39)):
        assert np.median(variance_of_mean(values).df) == pytest.approx(most, rel=0.06)
    # The excess kurtosis of Laplace's distribution is 3: 2 / (3 / 400 + 2 / 399) = 160.
    found = variance_of_mean(rng.laplace(size=(400, 4000)))
    assert 2 / (np.var(found.value) / np.mean(found.value) ** 2) == pytest.approx(160, rel=0.05)
    assert 2 / np.mean(2 / found.df) == pytest.approx(160, rel=0.05)
    alike = np.concatenate([np.zeros((30, 1)), np.ones((1, 1))])
    assert variance_of_mean(alike).df[0] < 3, "a single value decides"
    assert variance_of_mean(np.array([0.0, 1.0, 5.0])).df == 2
    assert variance_of_mean(np.array([0.0, np.nan, 1.0, 5.0])).df == 2


@pytest.mark.parametrize("strata", [1, 8])
def test_means_of_skewed_values_lie_in_their_interval(strata: int) -> None:
    """With n - 1 degrees of freedom it is 91.7 % of the means of 60 log-normal values."""
    rng, truth, repeats = np.random.default_rng(7), np.exp(0.5), 4000
    for n in (60, 150):
        values = rng.lognormal(size=(n, repeats, strata))
        variance = variance_of_mean(values)
        total = mean_of([Variance(variance.value[:, k], variance.df[:, k]) for k in range(strata)])
        means = values.mean(axis=(0, 2))
        bounds = np.array([total.of(k).interval(means[k], 0.95, "positive")
                           for k in range(repeats)])  # fmt: skip
        inside = np.mean((bounds[:, 0] <= truth) & (truth <= bounds[:, 1]))
        assert 0.925 < inside < 0.97


def test_strata_are_left_out_one_unit_at_a_time_and_add_up() -> None:
    rng = np.random.default_rng(0)
    parts = [rng.random(7), rng.random(12)]
    weights, strata = delete_one([7, 12])
    assert [each.shape for each in weights] == [(20, 7), (20, 12)]
    assert all((each[0] == 1).all() for each in weights)
    assert (sum(each[1:].sum(axis=1) for each in weights) == 18).all()
    means = [w @ part / w.sum(axis=1) for w, part in zip(weights, parts, strict=True)]
    found = jackknife(np.mean(means, axis=0)[1:], strata)
    each = [np.var(part, ddof=1) / len(part) for part in parts]
    assert found.value == pytest.approx(sum(each) / 4)
    df = [float(variance_of_mean(part).df) for part in parts]
    assert found.df == pytest.approx(sum(each) ** 2 / (each[0] ** 2 / df[0] + each[1] ** 2 / df[1]))
    together = mean_of([variance_of_mean(part) for part in parts])
    assert together.value == pytest.approx(float(found.value))
    assert together.df == pytest.approx(float(found.df))


def test_units_that_do_not_enter_are_not_counted() -> None:
    values = np.array([[0.1, 0.4], [0.3, 0.5], [0.2, np.nan]])
    used = np.array([[True, True], [True, True], [True, False]])
    found = jackknife(values, used=used)
    assert found.value[0] == pytest.approx(2 / 3 * 0.02)
    assert found.value[1] == pytest.approx(1 / 2 * 0.005) and found.df[1] == 1
    assert np.isnan(jackknife(values).value[1])
    assert np.isnan(jackknife(np.ones((1, 2))).value).all()


def test_the_excess_of_second_order_is_taken_off() -> None:
    """The square of a mean of n normal values around 0 has the variance 2 / n^2."""
    n, repeats = 12, 4000
    values = np.random.default_rng(1).normal(size=(n, repeats))
    total = values.sum(axis=0)
    pairs = np.stack(np.triu_indices(n, 1), axis=1)
    one = ((total - values) / (n - 1)) ** 2
    two = ((total - values[pairs[:, 0]] - values[pairs[:, 1]]) / (n - 2)) ** 2
    plain = jackknife(one).value
    excess = second_order((total / n) ** 2, one, two, pairs)
    assert np.mean(plain) > 1.7 * 2 / n**2
    assert np.mean(plain - excess) == pytest.approx(2 / n**2, rel=0.15)


def test_a_linear_statistic_has_no_second_order() -> None:
    values = np.random.default_rng(2).random((9, 3))
    pairs = np.stack(np.triu_indices(9, 1), axis=1)
    total = values.sum(axis=0)
    one = (total - values) / 8
    two = (total - values[pairs[:, 0]] - values[pairs[:, 1]]) / 7
    assert second_order(total / 9, one, two, pairs) == pytest.approx(0, abs=1e-20)


@settings(max_examples=60)
@given(
    st.floats(0.01, 0.99),
    st.floats(1e-6, 1.0),
    st.sampled_from(["identity", "fraction", "correlation", "positive"]),
)
def test_intervals_contain_their_value_and_stay_in_range(
    value: float, sd: float, scale: Scale
) -> None:
    variance = Variance(np.asarray(sd**2), np.asarray(30.0))
    low, high = variance.interval(value, 0.95, scale)
    assert low < value < high
    least, most = {"identity": (-np.inf, np.inf), "fraction": (0, 1), "correlation": (-1, 1),
                   "positive": (0, np.inf)}[scale]  # fmt: skip
    assert least <= low and high <= most
    wide = variance.interval(value, 0.99, scale)
    assert wide[0] <= low and high <= wide[1]


def test_small_variances_give_students_interval_on_every_scale() -> None:
    variance = Variance(np.asarray(1e-8), np.asarray(10.0))
    for scale in ("identity", "fraction", "correlation", "positive"):
        low, high = variance.interval(0.4, 0.95, scale)  # type: ignore[arg-type]
        assert (high - low) / 2e-4 == pytest.approx(2.2281, rel=1e-3)
    assert Variance(np.asarray(0.0), np.asarray(5.0)).interval(1.0) == (1.0, 1.0)
    assert np.isnan(Variance(np.asarray(np.nan), np.asarray(5.0)).interval(0.5)).all()


# --- bootstrap --------------------------------------------------------------------------------


@given(st.integers(1, 60), st.integers(0, 5))
def test_weights_draw_n_of_n_and_depend_only_on_their_names(n: int, seed: int) -> None:
    bootstrap = Bootstrap(resamples=7, seed=seed)
    weights = bootstrap.weights("drop", n)
    assert weights.shape == (7, n)
    assert (weights.sum(axis=1) == n).all() and (weights >= 0).all()
    assert np.array_equal(weights, Bootstrap(resamples=7, seed=seed).weights("drop", n))
    if n > 20:
        assert not np.array_equal(weights, Bootstrap(resamples=7, seed=seed + 1).weights("drop", n))
        assert not np.array_equal(weights, bootstrap.weights("link", n))


def test_width_matches_the_normal_interval() -> None:
    values = np.random.default_rng(0).random(400)
    bootstrap = Bootstrap(resamples=4000)
    low, high = bootstrap.interval(bootstrap.weights("x", 400) @ values / 400)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.05)


def test_intervals_leave_out_undefined_draws_until_they_are_most() -> None:
    draws = np.linspace(0, 1, 101)
    assert Bootstrap().interval(draws) == pytest.approx((0.025, 0.975))
    some = np.concatenate([draws, np.full(50, np.nan)])
    assert Bootstrap().interval(some) == Bootstrap().interval(draws)
    most = np.concatenate([draws, np.full(150, np.nan)])
    assert np.isnan(Bootstrap().interval(most)).all()


def test_no_draws_are_refused() -> None:
    with pytest.raises(BadInputError, match="bootstrap needs"):
        Bootstrap(resamples=0)


def test_intervals_of_fractions_match_wilson() -> None:
    for k, n in ((0, 10), (7, 10), (120, 199), (10, 10)):
        known = binomtest(k, n).proportion_ci(method="wilson")
        assert wilson(k / n, n) == pytest.approx((known.low, known.high), abs=1e-12)
    assert np.isnan(wilson(float("nan"), 10)).all() and np.isnan(wilson(0.5, 0)).all()
