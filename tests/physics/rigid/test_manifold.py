"""Manifolds of two boxes against points that can be worked out by hand."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from numpy.typing import NDArray

from physion.numerics.rotations import axis_angle_matrix
from physion.physics.rigid.manifold import (
    HullFaces,
    HullPose,
    ManifoldOptions,
    clip_faces,
    face_contacts,
    face_normal,
    floor_contacts,
    hull_faces,
    spread_points,
)

F64 = NDArray[np.float64]
OPTIONS = ManifoldOptions(contact_distance=0.02, parallel_cosine=0.9, floor=0.0)
UP = np.array([0.0, 0.0, 1.0])
UPRIGHT = np.eye(3)


def box(half: float) -> F64:
    return np.array(list(itertools.product((-half, half), repeat=3)))


def two_boxes(half_a: float, half_b: float) -> HullFaces:
    corners = [box(half_a), box(half_b)]
    loops = [face + 8 * i for i, hull in enumerate(corners) for face in hull_faces(hull)]
    return HullFaces(
        np.concatenate(corners),
        np.array([0, 8, 16], np.int64),
        np.concatenate(loops),
        np.cumsum([0, *(len(loop) for loop in loops)]),
        np.array([0, 6, 12], np.int64),
    )


def manifold(faces: HullFaces, rot_b: F64, height: float, lowest: float) -> tuple[F64, F64, F64]:
    """A at the origin, B ``height`` above it, turned by ``rot_b``; its lowest point is given."""
    a = HullPose(0, UPRIGHT, np.zeros(3), np.array([0.0, 0.0, 0.5]))
    b = HullPose(1, rot_b, np.array([0.0, 0.0, height]), np.array([0.0, 0.0, lowest]))
    return face_contacts(faces, a, b, UP, OPTIONS)


def test_a_box_has_six_faces_of_four_corners_and_unit_normals() -> None:
    faces = two_boxes(0.5, 0.5)
    assert [len(face) for face in hull_faces(box(0.5))] == [4] * 6
    normals = np.array([face_normal(faces, f) for f in range(6)])
    expected = np.concatenate([np.eye(3), -np.eye(3)])
    assert sorted(np.rint(normals).tolist()) == sorted(expected.tolist())
    assert np.abs(normals - np.rint(normals)).max() < 1e-12


def test_face_on_face_has_the_four_corners_and_their_depth() -> None:
    normal, points, separation = manifold(two_boxes(0.5, 0.5), UPRIGHT, 0.99, 0.49)
    assert normal.tolist() == pytest.approx([0, 0, 1])
    assert separation.tolist() == pytest.approx([-0.01] * 4)
    corners = [[x, y, 0.495] for x in (-0.5, 0.5) for y in (-0.5, 0.5)]
    assert sorted(np.round(points, 9).tolist()) == corners


def test_a_small_box_on_a_large_one_touches_with_its_own_corners() -> None:
    _, points, separation = manifold(two_boxes(0.5, 0.2), UPRIGHT, 0.71, 0.51)
    assert separation.tolist() == pytest.approx([0.01] * 4)
    corners = [[x, y, 0.505] for x in (-0.2, 0.2) for y in (-0.2, 0.2)]
    assert sorted(np.round(points, 9).tolist()) == corners


def test_boxes_rotated_by_45_degrees_overlap_in_an_octagon() -> None:
    rot = axis_angle_matrix(UP, math.pi / 4)
    square = np.array([[-0.5, -0.5, 0.0], [0.5, -0.5, 0.0], [0.5, 0.5, 0.0], [-0.5, 0.5, 0.0]])
    rotated = square @ rot.T - [0.0, 0.0, 0.01]
    points = clip_faces(square, np.ascontiguousarray(rotated), 0.02)
    far, near = 0.5, math.sqrt(0.5) - 0.5
    octagon = {
        (sx * u, sy * v) for u, v in ((far, near), (near, far)) for sx in (-1, 1) for sy in (-1, 1)
    }
    assert {tuple(p) for p in np.round(points[:, :2], 9)} == {
        (round(u, 9), round(v, 9)) for u, v in octagon
    }
    assert points[:, 3].tolist() == pytest.approx([-0.01] * 8)
    # Four of the eight stand for all: they span the octagon.
    normal, kept, separation = manifold(two_boxes(0.5, 0.5), rot, 0.99, 0.49)
    assert abs(normal @ UP) == pytest.approx(1.0)
    assert len(kept) == 4
    assert separation.tolist() == pytest.approx([-0.01] * 4)
    assert np.hypot(kept[:, 0], kept[:, 1]).tolist() == pytest.approx([math.hypot(far, near)] * 4)
    assert np.ptp(kept[:, 0]) > 0.7
    assert np.ptp(kept[:, 1]) > 0.7


def test_an_edge_on_a_face_touches_at_its_two_ends() -> None:
    rot = axis_angle_matrix([1.0, 0.0, 0.0], math.pi / 4)
    height = 0.5 + 0.3 * math.sqrt(2) - 0.004
    normal, points, separation = manifold(two_boxes(0.5, 0.3), rot, height, 0.496)
    assert normal.tolist() == pytest.approx([0, 0, 1])
    assert separation.tolist() == pytest.approx([-0.004] * 2)
    assert sorted(np.round(points, 9).tolist()) == [[-0.3, 0.0, 0.498], [0.3, 0.0, 0.498]]


def test_two_edges_give_no_manifold() -> None:
    a = axis_angle_matrix([1.0, 0.0, 0.0], math.pi / 4)
    b = axis_angle_matrix([0.0, 1.0, 0.0], math.pi / 4)
    top = 0.5 * math.sqrt(2)
    below = HullPose(0, a, np.zeros(3), np.array([0.0, 0.0, top]))
    above = HullPose(1, b, np.array([0.0, 0.0, 2 * top]), np.array([0.0, 0.0, top]))
    _, points, _ = face_contacts(two_boxes(0.5, 0.5), below, above, UP, OPTIONS)
    assert len(points) == 0


def test_faces_farther_apart_than_the_contact_distance_do_not_touch() -> None:
    _, points, _ = manifold(two_boxes(0.5, 0.5), UPRIGHT, 1.03, 0.53)
    assert len(points) == 0


def test_four_points_stand_for_all() -> None:
    grid = np.array([[x, y, 0.0] for x in range(5) for y in range(4)], float)
    depth = np.zeros(len(grid))
    depth[0] = -1.0
    corners = grid[spread_points(grid, depth)]
    assert sorted(corners[:, :2].tolist()) == [[0, 0], [0, 3], [4, 0], [4, 3]]


def test_floor_contacts_are_the_low_corners() -> None:
    points = floor_contacts(box(0.5), np.array([1.0, 2.0, 0.51]), UPRIGHT, OPTIONS)
    corners = [[x, y, 0.01] for x in (0.5, 1.5) for y in (1.5, 2.5)]
    assert sorted(np.round(points, 9).tolist()) == corners
    assert len(floor_contacts(box(0.5), np.array([0.0, 0.0, 0.53]), UPRIGHT, OPTIONS)) == 0
