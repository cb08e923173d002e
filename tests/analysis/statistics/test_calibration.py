"""Calibration of probabilities: against scikit-learn, and parts that add up."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.stats import binomtest
from sklearn.metrics import brier_score_loss

from physion.analysis.intervals import wilson
from physion.analysis.statistics.regression import (
    brier,
    calibration_table,
    decompose,
    reliability_curve,
)
from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]

forecasts = st.integers(1, 50).flatmap(
    lambda n: st.tuples(
        hnp.arrays(np.float64, n, elements=st.floats(0, 1)),
        hnp.arrays(np.float64, n, elements=st.sampled_from([0.0, 1.0])),
    )
)


@settings(deadline=None)
@given(forecasts, st.integers(1, 15))
def test_the_parts_of_the_brier_score_add_up(pair: tuple[Array, Array], bins: int) -> None:
    p, label = pair
    found = decompose(p, label, bins)
    assert found.brier == pytest.approx(float(np.mean((p - label) ** 2)))
    total = found.reliability - found.resolution + found.uncertainty + found.within
    assert total == pytest.approx(found.brier, abs=1e-12)
    curve = reliability_curve(p, label, bins)
    assert curve["stimuli"].sum() == len(p) and len(curve) == bins
    full = curve[curve["stimuli"] > 0]
    assert full["fraction"].between(full["low"] - 1e-12, full["high"] + 1e-12).all()
    assert full["mean_p"].between(full["from"] - 1e-9, full["to"] + 1e-9).all()
    gap = np.sum(full["stimuli"] / len(p) * (full["mean_p"] - full["fraction"]).abs())
    assert found.calibration_error == pytest.approx(gap, abs=1e-12)


def test_brier_matches_scikit_learn_and_knows_calibrated_forecasts() -> None:
    generator = np.random.default_rng(0)
    p = generator.random(20_000)
    label = (generator.random(20_000) < p).astype(float)
    assert brier(p, label) == pytest.approx(brier_score_loss(label, p))
    good, bold = decompose(p, label), decompose((p > 0.5).astype(float), label)
    assert good.calibration_error < 0.02 < 0.2 < bold.calibration_error
    assert good.skill > bold.skill and abs(good.within) < 0.01
    table = calibration_table(["good", "part"], np.stack([p, np.where(p < 0.5, p, np.nan)]), label)
    assert table["stimuli"].tolist() == [20_000, int(np.sum(p < 0.5))]


def test_forecasts_that_are_none_are_refused_and_one_outcome_has_no_skill() -> None:
    one = decompose([0.2, 0.9], [1, 1])
    assert np.isnan(one.skill) and "one outcome" in one.reason
    assert decompose([], []).reason == "no stimulus" and np.isnan(brier([], []))
    for p, label, words in (
        ([1.1], [1], "does not lie"),
        ([np.nan], [1], "does not lie"),
        ([0.1], [0.5], "0 or 1"),
        ([0.1, 0.2], [1], "do not pair"),
    ):
        with pytest.raises(BadInputError, match=words):
            brier(p, label)
    with pytest.raises(BadInputError, match="bins"):
        reliability_curve([0.1], [1], bins=0)


def test_intervals_of_fractions_match_wilson() -> None:
    for k, n in ((0, 10), (7, 10), (120, 199), (10, 10)):
        known = binomtest(k, n).proportion_ci(method="wilson")
        assert wilson(k / n, n) == pytest.approx((known.low, known.high), abs=1e-12)
    assert np.isnan(wilson(float("nan"), 10)).all() and np.isnan(wilson(0.5, 0)).all()
    curve = reliability_curve([0.61, 0.63, 0.66, 0.95], [1, 1, 0, 1]).iloc[6]
    known = binomtest(2, 3).proportion_ci(method="wilson")
    found = curve[["stimuli", "mean_p", "fraction", "low", "high"]].tolist()
    assert found == pytest.approx([3, 1.9 / 3, 2 / 3, known.low, known.high])
