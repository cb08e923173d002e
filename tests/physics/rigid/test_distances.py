"""Distances and depths of convex hulls against known answers and against other algorithms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from physion.numerics.rotations import axis_angle_matrix
from physion.physics.rigid.bodies import collision_hulls
from physion.physics.rigid.collision.closest_points import (
    APART,
    CLOSE,
    OVERLAPPING,
    new_simplex,
    reduce_simplex,
)
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

SEEDS = st.integers(0, 2**32 - 1)
CASES = settings(max_examples=80, deadline=None, derandomize=True)


def far_pair(seed: int, flattest: float = 0.01) -> tuple[NDArray[np.float64], ...]:
    """Two random hulls, a rotation, and a shift that mostly parts them."""
    rng = np.random.default_rng(seed)
    a, b = random_hull(rng, flattest), random_hull(rng, flattest)
    return a, b, random_rotation(rng), rng.normal(size=3)


@pytest.mark.parametrize("gap", [1e-6, 1e-3, 0.1, 7.0])
def test_face_to_face(gap: float) -> None:
    found = search(box(0.5), box(0.5), shift=[0.1, 0.2, 1.0 + gap])
    assert found.result == CLOSE
    assert found.distance == pytest.approx(gap, abs=1e-12)
    assert found.direction.tolist() == pytest.approx([0, 0, 1], abs=1e-9)
    assert found.point_a[2] == pytest.approx(0.5 + gap)
    assert found.point_b[2] == pytest.approx(0.5)
    assert found.point_a[:2].tolist() == pytest.approx(found.point_b[:2].tolist(), abs=1e-12)


def test_edge_to_edge() -> None:
    # Both boxes stand on an edge, B along x and A along y: their edges cross over the origin.
    below = box(0.5) @ axis_angle_matrix([1.0, 0, 0], math.pi / 4).T
    rot = axis_angle_matrix([0.0, 1.0, 0.0], math.pi / 4)
    found = search(box(0.5), below, rot, [0.0, 0.0, 2 * math.sqrt(0.5) + 0.03])
    assert found.result == CLOSE
    assert found.distance == pytest.approx(0.03, abs=1e-12)
    assert found.point_b.tolist() == pytest.approx([0, 0, math.sqrt(0.5)], abs=1e-12)
    assert found.point_a.tolist() == pytest.approx([0, 0, math.sqrt(0.5) + 0.03], abs=1e-12)


def test_corner_to_face() -> None:
    # The diagonal of A is upright, so that its lowest corner is sqrt(3) / 2 below its centre.
    diagonal = np.ones(3) / math.sqrt(3)
    axis = np.cross(diagonal, [0.0, 0.0, 1.0])
    rot = axis_angle_matrix(axis / np.linalg.norm(axis), math.acos(diagonal[2]))
    found = search(box(0.5), box(0.5), rot, [0.1, -0.2, 0.5 + math.sqrt(0.75) + 0.25])
    assert found.result == CLOSE
    assert found.distance == pytest.approx(0.25, abs=1e-12)
    assert found.point_a.tolist() == pytest.approx([0.1, -0.2, 0.75], abs=1e-12)
    assert found.point_b.tolist() == pytest.approx([0.1, -0.2, 0.5], abs=1e-12)


def test_corner_to_corner() -> None:
    found = search(box(0.5), box(0.5), shift=[1.3, 1.4, 2.2])
    assert found.distance == pytest.approx(1.3, abs=1e-12)  # sqrt(.3² + .4² + 1.2²)
    assert found.point_b.tolist() == pytest.approx([0.5] * 3)
    assert found.direction.tolist() == pytest.approx([0.3 / 1.3, 0.4 / 1.3, 1.2 / 1.3])


@pytest.mark.parametrize("gap", [0.0, 1e-9, -1e-9, -0.1, -0.9])
def test_touching_and_overlapping_boxes_overlap(gap: float) -> None:
    assert search(box(0.5), box(0.5), shift=[0.1, 0.2, 1.0 + gap]).result == OVERLAPPING


def test_a_hull_inside_another_overlaps() -> None:
    assert search(box(0.1), box(0.5), shift=[0.2, 0.1, 0.0]).result == OVERLAPPING
    assert search(box(0.5), box(0.1), shift=[0.2, 0.1, 0.0]).result == OVERLAPPING


@pytest.mark.parametrize(("reach", "result"), [(0.19, APART), (0.21, CLOSE)])
def test_hulls_farther_apart_than_the_reach_are_apart(reach: float, result: int) -> None:
    assert search(box(0.5), box(0.3), shift=[0, 0, 1.0], reach=reach).result == result


@CASES
@given(seed=SEEDS, flattest=st.sampled_from([1.0, 0.1, 0.01, 0.001]))
def test_the_distance_matches_a_least_squares_problem(seed: int, flattest: float) -> None:
    a, b, rot, shift = far_pair(seed, flattest)
    found = search(a, b, rot, shift)
    expected = distance_by_least_squares(differences(a, b, rot, shift))
    assert max(found.distance, 0.0) == pytest.approx(expected, abs=1e-9)
    if found.result == CLOSE:
        # No corner of either hull lies between the two planes through the closest points.
        along = found.direction
        assert np.linalg.norm(along) == pytest.approx(1.0)
        assert ((a @ rot.T + shift) @ along).min() >= found.point_a @ along - 1e-9
        assert (b @ along).max() <= found.point_b @ along + 1e-9
        gap = found.point_a - found.point_b
        assert gap.tolist() == pytest.approx((found.distance * along).tolist(), abs=1e-12)


@CASES
@given(seed=SEEDS)
def test_swapping_the_hulls_turns_the_direction_round(seed: int) -> None:
    a, b, rot, shift = far_pair(seed)
    found, swapped = search(a, b, rot, shift), search(b, a, rot.T, -rot.T @ shift)
    assert swapped.result == found.result
    assert swapped.distance == pytest.approx(found.distance, abs=1e-9)
    if found.result == CLOSE:
        assert (rot @ swapped.direction).tolist() == pytest.approx(
            (-found.direction).tolist(), abs=1e-6
        )


@CASES
@given(seed=SEEDS)
def test_a_rigid_motion_of_both_hulls_changes_nothing(seed: int) -> None:
    a, b, rot, shift = far_pair(seed)
    motion = random_rotation(np.random.default_rng(seed + 1))
    found, moved = search(a, b, rot, shift), search(a, b @ motion.T, motion @ rot, motion @ shift)
    assert moved.result == found.result
    assert moved.distance == pytest.approx(found.distance, abs=1e-9)
    if found.result == CLOSE:
        assert moved.direction.tolist() == pytest.approx(
            (motion @ found.direction).tolist(), abs=1e-6
        )


@CASES
@given(seed=SEEDS)
def test_a_search_from_the_last_simplex_finds_the_same(seed: int) -> None:
    """The hulls have moved a little since, or a lot."""
    a, b, rot, shift = far_pair(seed)
    rng = np.random.default_rng(seed)
    for step in (1e-4, 0.3):
        simplex = new_simplex()
        size = 3
        if search(a, b, rot, shift, simplex=simplex).result == CLOSE:
            size = int((simplex.weight > 0).sum())
        else:
            # Any corners will do as a start.
            simplex.corner[:3, 0] = rng.integers(0, len(a), 3)
            simplex.corner[:3, 1] = rng.integers(len(a), len(a) + len(b), 3)
        moved = shift + step * rng.normal(size=3)
        again = search(a, b, rot, moved, simplex=simplex, size=size)
        fresh = search(a, b, rot, moved)
        assert again.distance == pytest.approx(fresh.distance, abs=1e-9)


@pytest.mark.parametrize(
    ("corners", "left", "squared", "closest"),
    [
        ([[1, 2, 3]], 1, 14.0, [1, 2, 3]),
        ([[1, 1, 0], [1, -1, 0]], 2, 1.0, [1, 0, 0]),
        ([[1, 1, 0], [1, 3, 0]], 1, 2.0, [1, 1, 0]),
        ([[1, 1, 1], [-2, 1, 1], [1, -2, 1]], 3, 1.0, [0, 0, 1]),
        ([[1, 1, 1], [-2, 1, 1], [1, 2, 1]], 2, 2.0, [0, 1, 1]),
        ([[1, 1, 1], [-2, 1, 1], [1, -2, 1], [0, 0, 3]], 3, 1.0, [0, 0, 1]),
        ([[1, 1, 1], [-2, 1, 1], [1, -2, 1], [0, 0, -3]], 4, 0.0, None),
    ],
    ids=["point", "segment", "end of a segment", "triangle", "edge", "face", "inside"],
)
def test_the_point_of_a_simplex_closest_to_the_origin(
    corners: list[list[float]], left: int, squared: float, closest: list[float] | None
) -> None:
    simplex = new_simplex()
    simplex.point[: len(corners), :3] = corners
    assert reduce_simplex(simplex, len(corners)) == (left, pytest.approx(squared))
    if closest is not None:
        assert simplex.closest.tolist() == pytest.approx(closest)


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
