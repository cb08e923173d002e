"""Contact points of facing faces against points that can be worked out by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection

from physion.numerics.rotations import axis_angle_matrix
from physion.physics.rigid.bodies import face_planes, hull_faces
from physion.physics.rigid.collision.faces import (
    MAX_LOOP,
    clip_faces,
    face_points,
    facing_face,
    new_clip_space,
)
from physion.physics.rigid.collision.manifold import FAR, spread_points
from support.hull_pairs import NOWHERE, UPRIGHT, box, hulls_of

F64 = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])


def on_top(half_a: float, half_b: float, rot: F64, height: float, low: F64, reach: float = 0.02):
    """Contact points of box A at ``height`` over box B, whose lowest point is ``low``.

    Returns the normal, the points on A and on B, and the gaps.
    """
    clip = new_clip_space()
    shift = np.array([0.0, 0.0, height])
    below = np.array([low[0], low[1], half_b])
    hulls = hulls_of(box(half_a), box(half_b))
    count = face_points(
        hulls, 0, 1, rot, shift, UP, low, below, reach, UPRIGHT, NOWHERE, clip
    )  # fmt: skip
    points = clip.points[:count]
    return clip.normal, points[:, :3], points[:, 3:6], points[:, 6]


def rows(points: F64) -> list[list[float]]:
    return sorted(np.round(points, 9).tolist())


def test_a_box_has_six_faces_of_four_corners_and_unit_normals() -> None:
    faces = hull_faces(box(0.5))
    assert [len(face) for face in faces] == [4] * 6
    loops, first = np.concatenate(faces), np.arange(0, 25, 4)
    planes = face_planes(box(0.5), loops, first)
    expected = np.concatenate([np.eye(3), -np.eye(3)])
    assert sorted(np.rint(planes[:, :3]).tolist()) == sorted(expected.tolist())
    assert np.abs(planes[:, :3] - np.rint(planes[:, :3])).max() < 1e-12
    assert planes[:, 3].tolist() == pytest.approx([0.5] * 6)


def test_the_facing_face_looks_along_the_direction_and_passes_the_point() -> None:
    hulls = hulls_of(box(0.5))

    def normal(point: tuple[float, ...], direction: tuple[float, ...]) -> list[float]:
        face = facing_face(hulls, 0, *point, *direction)
        return np.rint(hulls.plane[face, :3]).tolist()

    assert normal((0.1, 0.2, 0.5), (0.0, 0.0, 1.0)) == [0, 0, 1]
    # On an edge, both faces pass through the point: the direction decides.
    assert normal((0.5, 0.0, 0.5), (0.6, 0.0, 0.8)) == [0, 0, 1]
    assert normal((0.5, 0.0, 0.5), (0.8, 0.0, 0.6)) == [1, 0, 0]
    # A face that the point is far inside of is no candidate, whatever the direction.
    assert normal((0.5, 0.0, 0.0), (0.0, 0.0, 1.0)) == [1, 0, 0]


def test_face_on_face_has_the_four_corners_and_their_depth() -> None:
    normal, a, b, gap = on_top(0.5, 0.5, UPRIGHT, 0.99, np.array([0, 0, 0.49]))
    assert normal.tolist() == pytest.approx([0, 0, 1])
    assert gap.tolist() == pytest.approx([-0.01] * 4)
    assert rows(a) == [[x, y, 0.49] for x in (-0.5, 0.5) for y in (-0.5, 0.5)]
    assert rows(b) == [[x, y, 0.5] for x in (-0.5, 0.5) for y in (-0.5, 0.5)]


@pytest.mark.parametrize(("half_a", "half_b"), [(0.2, 0.5), (0.5, 0.2)])
def test_the_smaller_face_touches_with_its_corners(half_a: float, half_b: float) -> None:
    height = half_a + half_b + 0.01
    _, a, b, gap = on_top(half_a, half_b, UPRIGHT, height, np.array([0, 0, half_b + 0.01]))
    assert gap.tolist() == pytest.approx([0.01] * 4)
    assert rows(b) == [[x, y, half_b] for x in (-0.2, 0.2) for y in (-0.2, 0.2)]
    assert rows(a) == [[x, y, round(half_b + 0.01, 9)] for x in (-0.2, 0.2) for y in (-0.2, 0.2)]


def test_offset_boxes_touch_in_the_rectangle_of_their_overlap() -> None:
    clip = new_clip_space()
    shift = np.array([0.3, 0.6, 1.005])
    near = np.array([0.3, 0.3, 0.505]), np.array([0.3, 0.3, 0.5])
    hulls = hulls_of(box(0.5), box(0.5))
    count = face_points(hulls, 0, 1, UPRIGHT, shift, UP, *near, 0.02, UPRIGHT, NOWHERE, clip)
    assert rows(clip.points[:count, 3:6]) == [[x, y, 0.5] for x in (-0.2, 0.5) for y in (0.1, 0.5)]
    assert clip.points[:count, 6].tolist() == pytest.approx([0.005] * 4)


def test_boxes_rotated_by_45_degrees_overlap_in_an_octagon() -> None:
    rot = axis_angle_matrix(UP, math.pi / 4)
    _, _, b, gap = on_top(0.5, 0.5, rot, 0.99, np.array([0, 0, 0.49]))
    far, near = 0.5, math.sqrt(0.5) - 0.5
    octagon = [
        [sx * u, sy * v, 0.5]
        for u, v in ((far, near), (near, far))
        for sx in (-1, 1)
        for sy in (-1, 1)
    ]
    assert rows(b) == rows(np.array(octagon))
    assert gap.tolist() == pytest.approx([-0.01] * 8)


def test_an_edge_on_a_face_touches_at_its_two_ends() -> None:
    rot = axis_angle_matrix([1.0, 0.0, 0.0], math.pi / 4)
    height = 0.5 + 0.3 * math.sqrt(2) - 0.004
    normal, a, b, gap = on_top(0.3, 0.5, rot, height, np.array([0, 0, 0.496]))
    assert normal.tolist() == pytest.approx([0, 0, 1])
    assert gap.tolist() == pytest.approx([-0.004] * 2)
    assert rows(b) == [[-0.3, 0.0, 0.5], [0.3, 0.0, 0.5]]
    assert rows(a) == [[-0.3, 0.0, 0.496], [0.3, 0.0, 0.496]]


def test_only_what_is_within_the_reach_touches() -> None:
    assert len(on_top(0.5, 0.5, UPRIGHT, 1.03, np.array([0, 0, 0.53]))[3]) == 0
    # Tilted by 0.1 about y, the box rests on one edge; the opposite one is 1 m sin 0.1 higher.
    rot = axis_angle_matrix([0.0, 1.0, 0.0], -0.1)
    corners = box(0.5) @ rot.T
    low = corners[np.argmin(corners[:, 2])]
    _, _, b, gap = on_top(0.5, 1.0, rot, 1.0 - low[2], np.array([low[0], 0, 1.0]))
    assert gap.max() < 0.02
    assert gap.min() == pytest.approx(0.0, abs=1e-12)
    assert sorted(np.round(b[:, 1], 9).tolist()) == [-0.5, 0.5]


def polygon(rng: np.random.Generator, center: F64) -> F64:
    """Corners (K, 2) of a random convex polygon, counterclockwise."""
    points = center + rng.normal(size=(rng.integers(3, 12), 2))
    return points[ConvexHull(points).vertices]


def area_of_overlap(a: F64, b: F64) -> float:
    """Area of the overlap of two convex polygons, from their half-planes."""
    planes = np.concatenate([ConvexHull(a).equations, ConvexHull(b).equations])
    # The centre of the largest circle inside: n . c + r <= d for every half-plane.
    widest = linprog([0, 0, -1], np.c_[planes[:, :2], np.ones(len(planes))], -planes[:, 2], bounds=[
        (None, None), (None, None), (None, 1.0)
    ])  # fmt: skip
    if widest.x[2] <= 1e-6:
        return 0.0
    return float(ConvexHull(HalfspaceIntersection(planes, widest.x[:2]).intersections).volume)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), tilt=st.floats(-0.5, 0.5))
def test_clipped_points_span_the_overlap_of_two_polygons(seed: int, tilt: float) -> None:
    """Whether corners of either lie inside the other, or only edges cross."""
    rng = np.random.default_rng(seed)
    a, b = polygon(rng, np.zeros(2)), polygon(rng, rng.uniform(-1, 1, 2))
    if rng.integers(2):
        b = b[::-1]
    reference, incident = np.zeros((MAX_LOOP, 3)), np.zeros((MAX_LOOP, 3))
    reference[: len(a)] = np.column_stack([a, np.full(len(a), 0.7)])
    incident[: len(b)] = np.column_stack([b, 0.7 + tilt * b[:, 0] - 0.1])
    clip = new_clip_space()
    count = clip_faces(reference, len(a), incident, len(b), 100.0, clip.low, clip.clipped)
    points = clip.clipped[:count]
    found = ConvexHull(points[:, :2]).volume if count > 2 else 0.0
    assert found == pytest.approx(area_of_overlap(a, b), abs=1e-9)
    # Heights are those of the incident plane, and over the reference face.
    assert points[:, 2].tolist() == pytest.approx((0.6 + tilt * points[:, 0]).tolist())
    assert points[:, 3].tolist() == pytest.approx((points[:, 2] - 0.7).tolist())
    near = clip_faces(reference, len(a), incident, len(b), -0.1, clip.low, clip.clipped)
    assert (clip.clipped[:near, 3] < -0.1).all()


def spread(points: F64, gap: F64) -> list[int]:
    clip = new_clip_space()
    clip.points[: len(points), 3:6] = points
    clip.points[: len(points), 6] = gap
    spread_points(clip.points, len(points), UP, clip.chosen)
    return clip.chosen.tolist()


GRID = np.array([[x, y, 0.0] for x in range(5) for y in range(4)], float)


def test_four_points_stand_for_all() -> None:
    gap = np.zeros(len(GRID))
    gap[0] = -1.0
    assert sorted(GRID[spread(GRID, gap)][:, :2].tolist()) == [[0, 0], [0, 3], [4, 0], [4, 3]]


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(5, 40))
@settings(max_examples=50, deadline=None, derandomize=True)
def test_the_deepest_and_the_farthest_from_it_are_always_among_four_points(
    seed: int, count: int
) -> None:
    rng = np.random.default_rng(seed)
    points = np.column_stack([rng.normal(size=(count, 2)), np.zeros(count)])
    gap = rng.uniform(-0.05, 0.0, count)
    chosen = spread(points, gap)
    deepest = int(np.argmin(gap))
    assert len(set(chosen)) == 4
    assert chosen[0] == deepest
    assert chosen[1] == int(np.argmax(np.linalg.norm(points - points[deepest], axis=1)))


def test_far_points_give_way_to_close_ones() -> None:
    # Corners of the grid at x = 4 are farther than the limit, all others are closer.
    gap = np.where(GRID[:, 0] == 4, FAR + 0.005, FAR / 2)
    gap[0] = 0.0
    assert (gap[spread(GRID, gap)] < FAR).all()
