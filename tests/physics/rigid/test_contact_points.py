"""Contact points: where they are, and what is kept, replaced, lost and found from step to step."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, HalfspaceIntersection

from physion.numerics.rotations import axis_angle_matrix, axis_angle_quaternion
from physion.physics.rigid.bodies import collision_hulls, face_planes, hull_faces
from physion.physics.rigid.collision.faces import (
    MAX_LOOP,
    Hulls,
    clip_faces,
    face_points,
    facing_face,
    new_clip_space,
)
from physion.physics.rigid.collision.manifold import (
    FAR,
    MOVED_FRACTIONS,
    ROTATED,
    add_point,
    clear_manifold,
    grown,
    has_moved,
    new_manifolds,
    refresh_points,
    set_direction,
    spread_points,
)
from physion.physics.rigid.collision.pairs import (
    BREAK_FRACTION,
    FLOOR_FRACTION,
    FLOOR_ROTATED,
    REPLACE_FRACTION,
    keep_pair,
    new_pair_space,
    still_apart,
    update_floor,
    update_pair,
)
from support.hull_pairs import NOWHERE, UPRIGHT, box, hulls_of, random_hull, search

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


NO_ROTATION = np.array([1.0, 0.0, 0.0, 0.0])
MARGIN, REACH = 0.05, 0.02


class Pair:
    """Hull A, which moves, on hull B or on the floor, which do not."""

    def __init__(self, hulls: Hulls, persistent: bool = True) -> None:
        self.hulls, self.persistent = hulls, persistent
        self.manifolds, self.space = new_manifolds(1), new_pair_space()
        self.manifolds.geoms[0] = 0, 1

    def pose(self, shift: ArrayLike, axis: ArrayLike, angle: float) -> F64:
        self.space.shift[:] = shift
        self.space.rot[:] = axis_angle_matrix(axis, angle)
        return np.asarray(axis_angle_quaternion(axis, angle), np.float64)

    def move(self, *shift: float, axis: tuple[float, ...] = (0, 0, 1.0), angle: float = 0) -> int:
        q = self.pose(shift, axis, angle)
        before = int(self.manifolds.size[0]) if self.persistent else -1
        if self.persistent and keep_pair(
            self.hulls, self.manifolds, 0, self.space.rot, self.space.shift, q, NO_ROTATION
        ):
            return before
        return update_pair(self.hulls, self.manifolds, 0, q, NO_ROTATION, before, REACH, self.space)

    def add(self, point: F64, replace: float) -> None:
        add_point(self.manifolds, 0, point, replace, self.space.old, self.space.clip.chosen)

    def on_floor(
        self, *shift: float, axis: tuple[float, ...] = (0, 0, 1.0), angle: float = 0
    ) -> int:
        q = self.pose(shift, axis, angle)
        return update_floor(
            self.hulls, self.manifolds, 0, q, REACH, 0.0, self.persistent, self.space
        )

    @property
    def points(self) -> F64:
        """Points on A, points on B, normals and gaps: (K, 10)."""
        m, count = self.manifolds, int(self.manifolds.size[0])
        parts = [m.point_a[0], m.point_b[0], m.normal[0], m.gap[0][:, None]]
        return np.concatenate(parts, axis=1)[:count].copy()

    def same_points(self, before: F64) -> list[bool]:
        """Whether each present point is among those of ``before``, but for its gap."""
        old = before[:, :9].tolist()
        return [point in old for point in self.points[:, :9].tolist()]


def boxes(persistent: bool = True, margin: float = MARGIN) -> Pair:
    return Pair(hulls_of(box(0.5), box(0.5), margin=margin), persistent)


def test_a_box_on_a_box_has_four_points_along_z() -> None:
    pair = boxes()
    assert pair.move(0, 0, 1.01) == 4
    assert sorted(pair.points[:, :3].tolist()) == [
        [x, y, -0.5] for x in (-0.5, 0.5) for y in (-0.5, 0.5)
    ]
    assert sorted(pair.points[:, 3:6].tolist()) == [
        [x, y, 0.5] for x in (-0.5, 0.5) for y in (-0.5, 0.5)
    ]
    assert pair.points[:, 9].tolist() == pytest.approx([0.01] * 4)
    assert pair.manifolds.direction[0].tolist() == [0.0, 0.0, 1.0]


def test_hulls_out_of_reach_have_no_points() -> None:
    assert boxes().move(0, 0, 1.03) == 0


def test_a_box_that_slides_a_little_keeps_its_points_and_renews_their_gaps() -> None:
    pair = boxes()
    pair.move(0, 0, 1.01)
    before = pair.points
    slide = 0.99 * MOVED_FRACTIONS[4] * MARGIN
    assert pair.move(slide, 0, 1.005) == 4
    assert np.array_equal(pair.points[:, :9], before[:, :9])
    assert pair.points[:, 9].tolist() == pytest.approx([0.005] * 4)


def test_points_within_their_limit_outlive_the_search_for_new_ones() -> None:
    pair = boxes()
    pair.move(0, 0, 1.01)
    before = pair.points
    # Beyond what needs a new search, within what breaks a point.
    slide = 0.03
    assert MOVED_FRACTIONS[4] * MARGIN < slide < BREAK_FRACTION * MARGIN
    assert pair.move(slide, 0, 1.01) == 4
    assert sum(pair.same_points(before)) >= 3
    assert pair.points[:, 9].tolist() == pytest.approx([0.01] * 4)


def test_a_box_that_slides_farther_than_its_margin_gets_new_points() -> None:
    pair = boxes()
    pair.move(0, 0, 1.01)
    before = pair.points
    slide = 1.01 * BREAK_FRACTION * MARGIN
    assert pair.move(slide, 0, 1.01) == 4
    assert not any(pair.same_points(before))
    # The two halves of every point are again over each other.
    assert np.abs(pair.points[:, :2] + [slide, 0] - pair.points[:, 3:5]).max() < 1e-12
    assert sorted(set(np.round(pair.points[:, 3], 9))) == [round(slide - 0.5, 9), 0.5]


def test_without_persistence_points_are_found_anew_in_every_step() -> None:
    pair = boxes(persistent=False)
    pair.move(0, 0, 1.01)
    pair.move(0.001, 0, 1.01)
    assert np.abs(pair.points[:, :2] + [0.001, 0] - pair.points[:, 3:5]).max() < 1e-12


def test_only_the_points_that_slid_are_lost() -> None:
    pair = boxes()
    pair.move(0, 0, 1.01)
    # Rotated about the corner (-0.5, -0.5), that point stays; its neighbours move by 0.06.
    angle = 0.06
    rot = axis_angle_matrix([0, 0, 1.0], angle)
    corner = np.array([-0.5, -0.5, -0.5])
    shift = corner - rot @ corner + np.array([0, 0, 1.01])
    refresh_points(pair.manifolds, 0, rot, shift, BREAK_FRACTION * MARGIN)
    assert pair.points[:, :3].tolist() == [[-0.5, -0.5, -0.5]]
    assert pair.points[0, 9] == pytest.approx(0.01)


def test_hulls_that_were_far_apart_need_no_search_until_they_could_have_met() -> None:
    pair = boxes()
    assert pair.move(0, 0, 1.5) == 0
    extent = float(pair.hulls.extent[0])

    def apart(height: float, angle: float = 0.0) -> bool:
        pair.pose([0, 0, height], [1.0, 0, 0], angle)
        space = pair.space
        return bool(still_apart(pair.manifolds, 0, space.rot, space.shift, extent, REACH))

    # The faces were 0.5 m apart: 0.48 m bring them within reach.
    assert [apart(1.5 - 0.479), apart(1.5 - 0.481)] == [True, False]
    # Rotated by 0.3, the low corner is sqrt(0.5) sin(45° + 0.3 rad) below the centre.
    low = math.sqrt(0.5) * math.sin(math.pi / 4 + 0.3)
    assert not apart(0.5 + low + REACH - 1e-9, 0.3)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1))
def test_hulls_that_are_said_to_be_apart_are(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = random_hull(rng), random_hull(rng)
    pair = Pair(hulls_of(a, b))
    pair.move(*rng.normal(size=3))
    if pair.manifolds.apart[0] == 0.0:
        return
    for size in (0.05, 0.3, 1.0):
        pair.pose(*size * rng.normal(size=(2, 3)), size)
        pair.space.shift[:] += pair.manifolds.apart_shift[0]
        extent, space = float(pair.hulls.extent[0]), pair.space
        if still_apart(pair.manifolds, 0, space.rot, space.shift, extent, REACH):
            assert search(a, b, space.rot, space.shift).distance > REACH


def test_parted_hulls_keep_points_that_are_no_contacts() -> None:
    pair = boxes()
    pair.move(0, 0, 1.01)
    count = pair.move(0, 0, 1.025)
    assert (pair.points[:count, 9] > REACH).all()


def test_a_direction_beyond_45_degrees_replaces_all_points() -> None:
    # A margin so large that nothing breaks: the box goes from the top of the other to its side.
    pair = boxes(margin=2.0)
    pair.move(0, 0, 1.01)
    assert pair.move(1.01, 0, 0) == 4
    assert pair.points[:, 6:9].tolist() == [[1.0, 0.0, 0.0]] * 4
    assert pair.manifolds.direction[0].tolist() == [1.0, 0.0, 0.0]


def test_a_direction_within_45_degrees_is_added_and_counts_for_half() -> None:
    # A roof with slopes of 20 degrees, and a small box over either slope.
    height = 0.5 * math.tan(math.radians(20))
    roof = np.array([[x, y, 0.0] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    roof = np.concatenate([roof, [[0.0, -0.5, height], [0.0, 0.5, height]]])
    pair = Pair(hulls_of(box(0.01), roof, margin=1.0))
    half = pair.hulls.radius[0] + height / 2
    assert pair.move(-0.25, 0, half) >= 1
    left = pair.manifolds.direction[0].copy()
    assert left.tolist() == pytest.approx(
        [-math.sin(math.radians(20)), 0, math.cos(math.radians(20))], abs=1e-9
    )
    count = int(pair.manifolds.size[0])
    assert pair.move(0.25, 0, half) >= count
    assert pair.manifolds.direction[0].tolist() == pytest.approx([0, 0, 1], abs=1e-9)


def row(x: float, y: float, gap: float) -> F64:
    """A point at (x, y) on both hulls, with an upright normal."""
    return np.array([x, y, 0.0, x, y, 0.0, 0, 0, 1.0, gap])


@pytest.mark.parametrize(("part", "count"), [(0.99, 1), (1.01, 2)])
def test_a_new_point_replaces_one_within_a_twentieth_of_the_margin(part: float, count: int) -> None:
    pair = boxes()
    replace = REPLACE_FRACTION * MARGIN
    pair.add(row(0, 0, 0.01), replace)
    pair.add(row(part * replace, 0, 0.005), replace)
    assert len(pair.points) == count
    assert pair.points[-1].tolist() == row(part * replace, 0, 0.005).tolist()


@pytest.mark.parametrize("deepest", range(5))
def test_five_points_become_four_with_the_deepest(deepest: int) -> None:
    pair = boxes()
    places = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0), (0.2, 0.1)]
    for k, (x, y) in enumerate(places):
        pair.add(row(x, y, -0.1 * (k == deepest)), 1e-3)
    kept = pair.points
    assert len(kept) == 4
    assert [*places[deepest]] in kept[:, :2].tolist()
    # The corners span more than the point in the middle.
    corners = set(places[:4])
    assert len(corners & {tuple(p) for p in kept[:, :2].tolist()}) == (3 if deepest == 4 else 4)


def test_a_dropped_point_takes_the_place_of_its_neighbour_if_it_is_deeper() -> None:
    pair = boxes()
    # The deepest is at (-1, -1); (0.9, 0.9) spans least, but is deeper than its neighbour (1, 1).
    for x, y, gap in [(-1, -1, -0.2), (1, -1, 0), (1, 1, 0), (-1, 1, 0), (0.9, 0.9, -0.1)]:
        pair.add(row(x, y, gap), 1e-3)
    kept = {tuple(p) for p in pair.points[:, :2].tolist()}
    assert kept == {(-1, -1), (1, -1), (-1, 1), (0.9, 0.9)}


@pytest.mark.parametrize("count", range(5))
@pytest.mark.parametrize("axis", range(3))
def test_a_pair_has_moved_beyond_a_part_of_its_margin(count: int, axis: int) -> None:
    manifolds = new_manifolds(1)
    manifolds.size[0] = count
    manifolds.rotation[0] = NO_ROTATION
    limit = MOVED_FRACTIONS[count] * MARGIN
    for part, moved in ((0.99, False), (1.01, True), (-1.01, True)):
        shift = part * limit * np.eye(3)[axis]
        found = has_moved(manifolds, 0, shift, NO_ROTATION, NO_ROTATION, MARGIN, 0.0)
        assert found == moved


@pytest.mark.parametrize("side", range(2))
@pytest.mark.parametrize("count", range(5))
def test_a_pair_has_moved_beyond_an_angle_or_an_arc(count: int, side: int) -> None:
    manifolds = new_manifolds(1)
    manifolds.size[0] = count
    manifolds.rotation[0] = NO_ROTATION

    def moved(angle: float, radius: float) -> bool:
        q = [NO_ROTATION, NO_ROTATION]
        q[side] = np.asarray(axis_angle_quaternion([0.6, 0, 0.8], angle), np.float64)
        return bool(has_moved(manifolds, 0, np.zeros(3), *q, MARGIN, radius))

    # q . q' is the cosine of half the angle.
    most = 2 * math.acos(ROTATED[count])
    assert [moved(part * most, 0.0) for part in (0.99, 1.01)] == [False, True]
    # Half the angle times the radius is compared with the part of the margin.
    limit = MOVED_FRACTIONS[count] * MARGIN
    assert [moved(0.01, part * limit / 0.005) for part in (0.99, 1.01)] == [False, True]


def test_the_direction_is_the_mean_of_the_normals() -> None:
    pair = boxes()
    set_direction(pair.manifolds, 0)
    assert pair.manifolds.direction[0].tolist() == [0, 0, 0]
    pair.manifolds.size[0] = 2
    pair.manifolds.normal[0, :2] = [[0.6, 0, 0.8], [-0.6, 0, 0.8]]
    set_direction(pair.manifolds, 0)
    assert pair.manifolds.direction[0].tolist() == [0, 0, 1]


def test_a_cleared_manifold_holds_nothing_and_a_grown_one_everything() -> None:
    pair = boxes()
    pair.move(0, 0, 1.01)
    pair.manifolds.anchor_count[0] = 2
    larger = grown(pair.manifolds, 5)
    for old, new in zip(pair.manifolds, larger, strict=True):
        assert len(new) == 5
        assert np.array_equal(new[:1], old)
    clear_manifold(larger, 0)
    assert (larger.size[0], larger.corners[0], larger.anchor_count[0]) == (0, 0, 0)


def test_the_floor_touches_the_low_corners() -> None:
    pair = boxes()
    assert pair.on_floor(1.0, 2.0, 0.51) == 4
    assert sorted(np.round(pair.points[:, 3:6], 9).tolist()) == [
        [x, y, 0.0] for x in (0.5, 1.5) for y in (1.5, 2.5)
    ]
    assert pair.points[:, 9].tolist() == pytest.approx([0.01] * 4)
    assert pair.manifolds.direction[0].tolist() == [0, 0, 1]
    assert boxes().on_floor(0.0, 0.0, 0.53) == 0


def test_floor_points_are_kept_within_a_fifth_of_the_margin() -> None:
    limit = FLOOR_FRACTION * MARGIN
    pair = boxes()
    pair.on_floor(0, 0, 0.51)
    before = pair.points
    pair.on_floor(0.99 * limit, 0, 0.51 - 0.005)
    assert np.array_equal(pair.points[:, :9], before[:, :9])
    assert pair.points[:, 9].tolist() == pytest.approx([0.005] * 4)
    pair.on_floor(1.01 * limit, 0, 0.51)
    assert pair.points[:, 3].tolist() == pytest.approx((before[:, 3] + 1.01 * limit).tolist())


def test_floor_points_are_found_anew_after_a_rotation() -> None:
    most = 2 * math.acos(FLOOR_ROTATED)
    for part, found_anew in ((0.99, False), (1.01, True)):
        # A box so small that no corner slides as far as the margin.
        pair = Pair(hulls_of(box(0.1), box(0.1), margin=1.0))
        pair.on_floor(0, 0, 0.1)
        before = pair.points
        pair.on_floor(0, 0, 0.1, angle=part * most)
        assert np.array_equal(pair.points[:, :9], before[:, :9]) != found_anew


def test_four_points_stand_for_a_round_foot() -> None:
    """A ball has more low corners than there is room for; a cylinder's are all equally low."""
    ball = collision_hulls("sphere", (0.05, 0.05, 0.05))[0].corners
    pair = Pair(hulls_of(ball, box(0.5)))
    lowest = float(ball[:, 2].min())
    assert (ball[:, 2] < lowest + REACH).sum() > 4
    assert len(ball) > 64
    assert pair.on_floor(0, 0, -lowest) == 4
    assert pair.points[:, 9].min() == pytest.approx(0.0, abs=1e-12)
    # Sunk as a whole, it has all its corners in reach: more than are clipped at a time.
    sunk = Pair(hulls_of(ball, box(0.5)))
    assert sunk.on_floor(0, 0, -1.0) == 4
    assert sunk.points[:, 9].min() == pytest.approx(lowest - 1.0)
    foot = collision_hulls("cylinder", (0.4, 0.4, 0.4))[0].corners
    round_foot = Pair(hulls_of(foot, box(0.5)))
    assert round_foot.on_floor(0, 0, -float(foot[:, 2].min())) == 4
    # Points on the rim, about a quarter of the way round from each other.
    rim = round_foot.points[:, 3:5]
    assert np.linalg.norm(rim, axis=1).tolist() == pytest.approx([0.2] * 4)
    around = np.sort(np.arctan2(rim[:, 1], rim[:, 0]))
    assert np.diff(around, append=around[0] + 2 * np.pi).max() < 0.6 * np.pi
