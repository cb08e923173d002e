"""Variances from leaving units out: against formulas, and without the bias of second order."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from physion.analysis.statistics.jackknife import (
    Scale,
    Variance,
    delete_one,
    jackknife,
    mean_of,
    second_order,
    variance_of_mean,
)

values_of_units = hnp.arrays(
    np.float64, st.integers(3, 30), elements=st.integers(0, 1000).map(lambda k: k / 1e3)
)


@given(values_of_units)
def test_the_variance_of_a_mean_is_that_of_the_textbook(values: np.ndarray) -> None:
    without = (1 - np.eye(len(values))) @ values / (len(values) - 1)
    expected = np.var(values, ddof=1) / len(values)
    for found in (jackknife(without), variance_of_mean(values)):
        assert found.value == pytest.approx(expected, abs=1e-12)
    if expected > 1e-12:
        assert jackknife(without).df == pytest.approx(len(values) - 1)


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
    assert found.df == pytest.approx(sum(each) ** 2 / (each[0] ** 2 / 6 + each[1] ** 2 / 11))
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
