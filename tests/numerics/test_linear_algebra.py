"""Small matrices, rotations, normal numbers and the Fourier transform against references."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from physion.numerics import linear_algebra as algebra
from physion.numerics import rotations
from physion.numerics.elementary import standard_normal
from physion.numerics.linear_algebra import inverse_real_transform

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
    again = standard_normal(np.random.default_rng(4), (500, 401))
    assert np.array_equal(draws, again)
    assert standard_normal(np.random.default_rng(4), 0).shape == (0,)


def test_the_inverse_transform_matches_numpy() -> None:
    picture = RNG.normal(size=(64, 64))
    spectrum = np.fft.rfft2(picture)
    assert inverse_real_transform(spectrum) == pytest.approx(picture, abs=1e-12)
