"""Elementary functions, linear algebra and rotations against the C library and NumPy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from physion.numerics import elementary, rotations
from physion.numerics import linear_algebra as algebra
from physion.numerics.elementary import standard_normal
from physion.numerics.linear_algebra import inverse_real_transform

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


RNG = np.random.default_rng(3)
MATRICES = RNG.normal(size=(7, 3, 3))
VECTORS = RNG.normal(size=(7, 3))


def test_products_and_lengths() -> None:
    assert algebra.multiply(MATRICES, MATRICES[::-1]) == pytest.approx(MATRICES @ MATRICES[::-1])
    assert algebra.apply(MATRICES[0], VECTORS) == pytest.approx(VECTORS @ MATRICES[0].T)
    assert algebra.dot(VECTORS, VECTORS[0]) == pytest.approx(VECTORS @ VECTORS[0])
    assert algebra.norm(VECTORS) == pytest.approx(np.linalg.norm(VECTORS, axis=1))
    assert algebra.norm(algebra.unit(VECTORS)) == pytest.approx(1.0)
    assert algebra.outer(VECTORS[0], VECTORS[1]) == pytest.approx(np.outer(*VECTORS[:2]))
    assert algebra.determinant(MATRICES) == pytest.approx(np.linalg.det(MATRICES))
    assert algebra.inverse(MATRICES[0]) == pytest.approx(np.linalg.inv(MATRICES[0]))
    assert not np.isfinite(algebra.inverse(np.ones((3, 3)))).any()


def test_sums_run_in_order() -> None:
    # From left to right the first 1 is lost; added in pairs it would not be.
    assert algebra.ordered_sum(np.array([1e16, 1.0, -1e16, 1.0])) == 1.0
    table = np.array([[1e16, 1.0, -1e16, 1.0], [1.0, 2.0, 3.0, 4.0]])
    assert algebra.ordered_sum(table).tolist() == [1.0, 10.0]
    assert algebra.ordered_sum(table, axis=0).tolist() == [1e16 + 1, 3.0, -1e16 + 3, 5.0]
    assert algebra.ordered_sum(np.zeros((2, 0))).tolist() == [0.0, 0.0]
    assert algebra.ordered_mean(table[1]) == 2.5 and np.isnan(algebra.ordered_mean(np.zeros(0)))


@settings(deadline=None)  # the first call compiles
@given(arrays(np.float64, (2, 4), elements=st.floats(-1, 1)).filter(
    lambda q: bool((np.abs(q).max(axis=1) > 0.1).all())))  # fmt: skip
def test_rotations_agree_with_each_other(pair: np.ndarray) -> None:
    a, b = algebra.unit(pair)
    v = np.array([0.3, -2.0, 1.1])
    matrix = rotations.rotation_matrices(a)
    assert rotations.rotate_vectors(a, v) == pytest.approx(matrix @ v, abs=1e-12)
    assert rotations.rotate_vector(a, v) == pytest.approx(matrix @ v, abs=1e-12)
    assert rotations.rotation_matrix(a) == pytest.approx(matrix, abs=0)
    product = rotations.multiply_quaternions(a, b)
    both = matrix @ rotations.rotation_matrices(b)
    assert rotations.rotation_matrices(product) == pytest.approx(both, abs=1e-12)
    back = rotations.rotate_vectors(rotations.conjugate(a), matrix @ v)
    assert back == pytest.approx(v, abs=1e-12)
    assert np.linalg.det(matrix) == pytest.approx(1.0)


def test_a_quarter_turn_about_z_takes_x_to_y() -> None:
    q = rotations.axis_angle_quaternion((0, 0, 2), np.pi / 2)
    assert rotations.rotate_vectors(q, (1, 0, 0)) == pytest.approx((0, 1, 0), abs=1e-15)
    matrix = rotations.axis_angle_matrix((0, 0, 2), np.pi / 2)
    assert matrix @ (1, 0, 0) == pytest.approx((0, 1, 0), abs=1e-15)


def test_normal_numbers_have_the_moments_and_tails_of_their_distribution() -> None:
    draws = standard_normal(np.random.default_rng(4), (500, 401))
    assert draws.shape == (500, 401)
    flat = draws.ravel()
    assert flat.mean() == pytest.approx(0, abs=0.01) and flat.std() == pytest.approx(1, abs=0.01)
    assert (flat**4).mean() == pytest.approx(3, abs=0.1)
    assert (np.abs(flat) > 3).mean() == pytest.approx(0.0027, abs=0.0006)
    # They are made in pairs, one number of each in the first half and one in the second.
    first, second = flat.reshape(2, -1)
    assert np.corrcoef(first, second)[0, 1] == pytest.approx(0, abs=0.015)
    assert np.corrcoef(first**2, second**2)[0, 1] == pytest.approx(0, abs=0.015)
    again = standard_normal(np.random.default_rng(4), (500, 401))
    assert np.array_equal(draws, again)
    assert standard_normal(np.random.default_rng(4), 0).shape == (0,)


def test_the_inverse_transform_matches_numpy() -> None:
    picture = RNG.normal(size=(64, 64))
    spectrum = np.fft.rfft2(picture)
    assert inverse_real_transform(spectrum) == pytest.approx(picture, abs=1e-12)
