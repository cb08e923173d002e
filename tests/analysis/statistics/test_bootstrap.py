"""Intervals: repeatable, of the right width, honest about what is undefined."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from physion.analysis.intervals import Bootstrap
from physion.core.errors import BadInputError


@given(st.integers(1, 60), st.integers(0, 5))
def test_weights_draw_n_of_n_and_depend_only_on_their_names(n: int, seed: int) -> None:
    bootstrap = Bootstrap(resamples=7, seed=seed)
    weights = bootstrap.weights("drop", n)
    assert weights.shape == (7, n)
    assert (weights.sum(axis=1) == n).all() and (weights >= 0).all()
    assert np.array_equal(weights, Bootstrap(resamples=7, seed=seed).weights("drop", n))


def test_seeds_and_strata_differ() -> None:
    weights = Bootstrap(resamples=5).weights("drop", 30)
    assert not np.array_equal(weights, Bootstrap(resamples=5, seed=1).weights("drop", 30))
    assert not np.array_equal(weights, Bootstrap(resamples=5).weights("link", 30))


@settings(max_examples=40)
@given(
    hnp.arrays(np.float64, st.integers(8, 40), elements=st.integers(0, 1000).map(lambda k: k / 1e3))
)
def test_the_interval_of_a_mean_of_symmetric_values_holds_the_mean(half: np.ndarray) -> None:
    values = np.concatenate([half, 1 - half])
    bootstrap = Bootstrap(resamples=400)
    low, high = bootstrap.interval(bootstrap.weights("x", len(values)) @ values / len(values))
    assert low - 1e-9 <= values.mean() <= high + 1e-9


def test_width_matches_the_normal_interval() -> None:
    values = np.random.default_rng(0).random(400)
    bootstrap = Bootstrap(resamples=4000)
    low, high = bootstrap.interval(bootstrap.weights("x", 400) @ values / 400)
    assert high - low == pytest.approx(2 * 1.96 * values.std() / 20, rel=0.05)


def test_a_higher_level_is_wider() -> None:
    draws = np.linspace(0, 1, 1001)
    assert Bootstrap(level=0.95).interval(draws) == pytest.approx((0.025, 0.975))
    assert Bootstrap(level=0.5).interval(draws) == pytest.approx((0.25, 0.75))


def test_undefined_draws_are_left_out_until_they_are_most() -> None:
    draws = np.linspace(0, 1, 101)
    some = np.concatenate([draws, np.full(50, np.nan)])
    assert Bootstrap().interval(some) == Bootstrap().interval(draws)
    most = np.concatenate([draws, np.full(150, np.nan)])
    assert np.isnan(Bootstrap().interval(most)).all()


@pytest.mark.parametrize("wrong", [{"resamples": 0}, {"level": 1.0}, {"level": 0.0}])
def test_senseless_settings_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(BadInputError, match="bootstrap needs"):
        Bootstrap(**wrong)  # type: ignore[arg-type]
