"""Depths of overlapping hulls against known answers and the facets of the Minkowski difference."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from physion.numerics.rotations import axis_angle_matrix
from physion.physics.rigid.bodies import collision_hulls
from physion.physics.rigid.collision.closest_points import CLOSE, OVERLAPPING, new_simplex
from physion.physics.rigid.collision.penetration import new_polytope, penetration
from support.hull_pairs import (
    UPRIGHT,
    box,
    depth_by_facets,
    differences,
    distance_by_least_squares,
    random_hull,
    random_rotation,
    search,
)

CASES = settings(max_examples=80, deadline=None, derandomize=True)
SEEDS = st.integers(0, 2**32 - 1)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1, 1])
@pytest.mark.parametrize("depth", [1e-6, 1e-3, 0.1])
def test_boxes_part_along_the_axis_of_least_overlap(axis: int, sign: int, depth: float) -> None:
    out = np.eye(3)[axis] * sign
    shift = np.full(3, 0.15) * (1 - np.abs(out)) + out * (0.5 + 0.3 - depth)
    found = search(box(0.3), box(0.5), shift=shift)
    assert found.result == OVERLAPPING
    assert -found.distance == pytest.approx(depth, abs=1e-9)
    assert found.direction.tolist() == pytest.approx(out.tolist(), abs=1e-6)
    assert (found.point_b - found.point_a).tolist() == pytest.approx((depth * out).tolist())
    assert found.point_b @ out == pytest.approx(0.5)


def test_a_small_box_leaves_a_large_one_by_the_nearest_face() -> None:
    found = search(box(0.1), box(0.5), shift=[0.05, 0.2, -0.1])
    assert -found.distance == pytest.approx(0.5 - 0.2 + 0.1, abs=1e-9)
    assert found.direction.tolist() == pytest.approx([0, 1, 0], abs=1e-6)


def test_boxes_at_one_place_part_along_their_smallest_sum() -> None:
    found = search(box(0.3, 0.2, 0.4), box(0.5, 0.4, 0.1))
    assert -found.distance == pytest.approx(0.5, abs=1e-9)
    assert np.abs(found.direction).tolist() == pytest.approx([0, 0, 1], abs=1e-6)


def test_a_touch_has_no_depth() -> None:
    found = search(box(0.3), box(0.5), shift=[0.1, 0.2, 0.8])
    assert -found.distance == pytest.approx(0.0, abs=1e-9)
    assert found.direction.tolist() == pytest.approx([0, 0, 1], abs=1e-6)


def test_crossing_edges_part_along_their_common_normal() -> None:
    quarter = np.pi / 4
    below = box(0.5) @ axis_angle_matrix([1.0, 0, 0], quarter).T
    found = search(
        box(0.5), below, axis_angle_matrix([0, 1.0, 0], quarter), [0, 0, 2 * np.sqrt(0.5) - 0.02]
    )
    assert -found.distance == pytest.approx(0.02, abs=1e-9)
    assert found.direction.tolist() == pytest.approx([0, 0, 1], abs=1e-6)


@CASES
@given(seed=SEEDS, flattest=st.sampled_from([1.0, 0.1, 0.01, 0.001]))
def test_the_depth_is_the_least_over_the_facets_of_the_difference(
    seed: int, flattest: float
) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_hull(rng, flattest), random_hull(rng, flattest)
    rot, shift = random_rotation(rng), 0.2 * rng.normal(size=3)
    depth = depth_by_facets(differences(a, b, rot, shift))
    assume(depth > 1e-6)
    found = search(a, b, rot, shift)
    assert found.result == OVERLAPPING
    assert -found.distance == pytest.approx(depth, abs=1e-8)
    apart = found.point_b - found.point_a
    assert apart.tolist() == pytest.approx((depth * found.direction).tolist(), abs=1e-8)
    # Moved by a little more than the depth, the hulls no longer overlap.
    moved = search(a, b, rot, shift + (depth + 1e-4) * found.direction)
    assert moved.result == CLOSE
    assert moved.distance == pytest.approx(1e-4, abs=1e-8)
    swapped = search(b, a, rot.T, -rot.T @ shift)
    assert swapped.distance == pytest.approx(found.distance, abs=1e-8)


SHAPES = ["cube", "cylinder", "sphere", "cone", "pyramid", "torus", "bowl", "pentagon"]


@settings(max_examples=150, deadline=None, derandomize=True)
@given(
    names=st.tuples(st.sampled_from(SHAPES), st.sampled_from(SHAPES)),
    turn=st.tuples(st.sampled_from([0, 1, 2]), st.sampled_from([0.0, 1e-9, 1e-5, 0.25, 0.5, 1.0])),
    along=st.sampled_from([0, 1, 2]),
    aside=st.tuples(*[st.sampled_from([0.0, 0.05, 0.1])] * 3),
    gap=st.sampled_from([0.0, 1e-10, -1e-10, 1e-8, -1e-8, 1e-6, -1e-6, 1e-3, -1e-3, -0.05]),
)
def test_symmetric_shapes_in_line_lose_no_pair(
    names: tuple[str, str],
    turn: tuple[int, float],
    along: int,
    aside: tuple[float, float, float],
    gap: float,
) -> None:
    """Parallel faces, shared planes and touches, where rounding decides, keep the right gap."""
    a, b = (collision_hulls(name, (0.3, 0.3, 0.3))[0].corners for name in names)
    rot = axis_angle_matrix(np.eye(3)[turn[0]], np.pi * turn[1])
    out, moved = np.eye(3)[along], a @ rot.T
    shift = (b.mean(0) - moved.mean(0) + aside) * (1 - out)
    shift += out * ((b @ out).max() - (moved @ out).min() + gap)
    points = differences(a, b, rot, shift)
    depth = depth_by_facets(points)
    expected = -depth if depth > 1e-12 else distance_by_least_squares(points)
    # Closer than 1e-7 m counts as touching, without depth.
    assert search(a, b, rot, shift).distance == pytest.approx(expected, abs=1.1e-7)


def test_flat_simplices_are_completed() -> None:
    """The search for closest points may end with a corner, an edge or a triangle at the origin."""
    corners = np.concatenate([box(0.5), box(0.5)])
    span = np.array([0, 8, 8, 16], np.int64)
    shift = np.array([0.0, 0.0, 0.9])
    for rows in ([[0, 8]], [[0, 8], [4, 8]], [[0, 8], [2, 8], [1, 8]]):
        simplex, out = new_simplex(), np.zeros(10)
        simplex.corner[: len(rows)] = rows
        for k, (i, j) in enumerate(rows):
            simplex.point[k, 3:6], simplex.point[k, 6:9] = corners[i] + shift, corners[j]
            simplex.point[k, :3] = simplex.point[k, 3:6] - corners[j]
        polytope = new_polytope()
        assert penetration(corners, span, UPRIGHT, shift, simplex, len(rows), polytope, out)
        assert out[9] == pytest.approx(0.1, abs=1e-9)
        assert out[:3].tolist() == pytest.approx([0, 0, 1], abs=1e-9)
