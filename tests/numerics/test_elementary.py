"""Elementary functions against the C library, known values and identities."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from physion.numerics import elementary

ULP = 2.0**-52
CASES: dict[str, tuple[Any, tuple[float, float], float]] = {
    "sin": (math.sin, (-50.0, 50.0), 2),
    "cos": (math.cos, (-50.0, 50.0), 2),
    "tan": (math.tan, (-1.5, 1.5), 6),
    "arctan": (math.atan, (-20.0, 20.0), 6),
    "arcsin": (math.asin, (-1.0, 1.0), 6),
    "arccos": (math.acos, (-1.0, 1.0), 6),
    "exp": (math.exp, (-700.0, 700.0), 2),
    "log": (math.log, (1e-6, 1e3), 2),
    "tanh": (math.tanh, (-4.0, 4.0), 7),
}


@pytest.mark.parametrize("name", CASES)
def test_values_match_the_c_library_to_a_few_units_in_the_last_place(name: str) -> None:
    reference, (low, high), tolerance = CASES[name]
    function = getattr(elementary, name)
    values = np.random.default_rng(1).uniform(low, high, 4000)
    expected = np.array([reference(v) for v in values.tolist()])
    found = function(values)
    # The C library itself is off by up to one unit.
    units = np.abs(found - expected) / np.array([math.ulp(e) for e in expected.tolist()])
    assert units.max() <= tolerance + 1
    assert [function(v) for v in values[:50].tolist()] == found[:50].tolist()
    assert function(values.reshape(40, 100)).shape == (40, 100)


def test_sine_and_cosine_of_many_turns() -> None:
    turns = np.array([100.5, 12345.25, 1e5, 249999.75])
    angles = 2 * np.pi * turns
    expected = [math.sin(a) for a in angles.tolist()]
    assert elementary.sin(angles) == pytest.approx(expected, abs=4 * ULP)
    assert math.isnan(elementary.sin(1.7e6)) and math.isnan(elementary.cos(-math.inf))
    assert math.isnan(elementary.tan(math.nan))


def test_exact_values_and_limits() -> None:
    e = elementary
    assert (e.sin(0.0), e.cos(0.0), e.exp(0.0), e.log(1.0), e.tanh(0.0)) == (0, 1, 1, 0, 0)
    assert e.exp(710.0) == math.inf and e.exp(-746.0) == 0.0 and e.exp(-745.0) > 0.0
    assert e.log(0.0) == -math.inf and math.isnan(e.log(-1.0)) and e.log(math.inf) == math.inf
    assert e.exp(-math.inf) == 0.0 and e.exp(math.inf) == math.inf
    assert e.tanh(30.0) == 1.0 and e.tanh(-math.inf) == -1.0
    assert e.arcsin(1.0) == math.pi / 2 and e.arccos(-1.0) == math.pi
    assert e.arctan(math.inf) == math.pi / 2 and math.isnan(e.arcsin(1.1))
    assert e.log(5e-324) == pytest.approx(math.log(5e-324), rel=1e-15)


def test_angles_of_vectors_in_every_quadrant() -> None:
    ways = [(1, 0), (1, 1), (0, 1), (-1, 1), (-1, 0), (-1, -1), (0, -1), (2, -3), (0, 0)]
    for x, y in ways:
        assert elementary.arctan2(y, x) == pytest.approx(math.atan2(y, x), abs=4 * ULP)
    ys, xs = np.random.default_rng(2).uniform(-1, 1, (2, 30, 10))
    assert elementary.arctan2(ys, xs) == pytest.approx(np.arctan2(ys, xs), abs=8 * ULP)


def test_powers() -> None:
    values = np.array([0.0, 0.25, 1.0, 2.0, 81.0])
    assert elementary.power(values, 0.5) == pytest.approx(np.sqrt(values), rel=1e-15)
    assert elementary.power(values, 1.15)[3] == pytest.approx(2**1.15, rel=1e-14)
    assert elementary.power(np.zeros(1), -1.0)[0] == math.inf
    assert elementary.power_of(0.0, 0.0) == 1.0 and elementary.power_of(0.0, 2.5) == 0.0


def test_the_coarse_logarithm_is_near_exact_at_powers_of_2_and_never_falls() -> None:
    coarse = elementary.coarse_log2_of
    values = np.concatenate([np.geomspace(1.0, 300.0, 5000), np.geomspace(1e-300, 1e300, 200)])
    found = np.array([coarse(v) for v in values.tolist()])
    assert np.abs(found - np.log2(values)).max() < 2e-5
    assert (np.diff(found[:5000]) > 0).all()
    assert [coarse(2.0**k) for k in (-30, -1, 0, 1, 9)] == [-30, -1, 0, 1, 9]
    below = [coarse(math.nextafter(2.0**k, 0.0)) for k in (-1, 1, 9)]
    assert below == pytest.approx([-1, 1, 9], abs=1e-14)


def test_bits_stay_what_they_are() -> None:
    """Whoever changes a last bit changes every scene: see `physion.trials.making.reproduce`."""
    assert elementary.sin(1.0).hex() == "0x1.aed548f090ceep-1"
    assert elementary.cos(1.0).hex() == "0x1.14a280fb5068cp-1"
    assert elementary.exp(1.0).hex() == "0x1.5bf0a8b14576ap+1"
    assert elementary.log(10.0).hex() == "0x1.26bb1bbb55516p+1"
    assert elementary.arctan2(3.0, -2.0).hex() == "0x1.145385fa3af72p+1"
