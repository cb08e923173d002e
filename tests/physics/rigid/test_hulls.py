"""Hulls of shapes, their faces and margins, and the summary of contacts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physion.numerics.rotations import axis_angle_quaternion, rotation_matrices
from physion.physics.rigid.bodies import (
    RigidSettings,
    build_model,
    collision_hulls,
    hull_faces,
    inner_box,
)
from physion.physics.trajectory import ENVIRONMENT, summarise_contacts
from physion.scenes.scene import Body, Joint
from support.hull_pairs import box, hulls_of, random_hull
from support.rigid_scenes import scene_of

SHAPES = ["cube", "cylinder", "sphere", "cone", "pyramid", "torus", "bowl", "pipe", "pentagon"]


@pytest.mark.parametrize("name", SHAPES)
def test_every_corner_belongs_to_three_faces_and_lies_on_them(name: str) -> None:
    for hull in collision_hulls(name, (0.3, 0.4, 0.5)):
        counts = np.bincount(np.concatenate(hull.faces), minlength=len(hull.corners))
        assert counts.min() >= 3
        planes = hulls_of(hull.corners).plane
        heights = hull.corners @ planes[:, :3].T - planes[:, 3]
        # No corner is outside; those of a face are on its plane, which may be slightly bent.
        assert heights.max() < 1e-4
        # Euler: a closed surface has two more corners and faces than edges.
        edges = sum(len(face) for face in hull.faces) / 2
        assert len(hull.corners) + len(hull.faces) == edges + 2


def test_a_cylinder_rests_on_its_rim_and_not_on_its_middle() -> None:
    (hull,) = collision_hulls("cylinder", (0.4, 0.4, 0.4))
    assert np.linalg.norm(hull.corners[:, :2], axis=1).min() == pytest.approx(0.2)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_inner_box_lies_inside(seed: int) -> None:
    corners = random_hull(np.random.default_rng(seed), 0.1)
    center = corners.mean(0)
    half = inner_box(corners, tuple(hull_faces(corners)), center)
    planes = hulls_of(corners).plane
    assert (half > 0).all()
    assert ((box(*half) + center) @ planes[:, :3].T - planes[:, 3]).max() < 1e-9


def test_the_inner_box_of_a_box_is_the_box_where_two_sides_are_equal() -> None:
    for half in ([0.5, 0.5, 0.5], [0.7, 0.2, 0.2], [0.2, 0.2, 0.7]):
        corners = box(*half)
        found = inner_box(corners, tuple(hull_faces(corners)), np.zeros(3))
        assert found.tolist() == pytest.approx(half)


@pytest.mark.parametrize(
    ("side", "margin", "tolerance"),
    [(0.2, 0.025, 0.01), (0.3, 0.0375, 0.015), (0.4, 0.05, 0.02), (2.0, 0.05, 0.05)],
)
def test_margins_are_parts_of_the_half_side(side: float, margin: float, tolerance: float) -> None:
    model = build_model(scene_of(Body("a", "cube", (0, 0, 0), (side,) * 3)), RigidSettings())
    hulls = model.hulls
    assert hulls.margin[0] == pytest.approx(margin)
    assert hulls.tolerance[0] == pytest.approx(tolerance)
    assert hulls.radius[0] == pytest.approx(np.sqrt(3) * side / 2)
    assert hulls.extent[0] == pytest.approx(np.sqrt(3) * side / 2)
    assert hulls.box[0].tolist() == pytest.approx([0, 0, 0, side / 2, side / 2, side / 2])


def test_hulls_of_joined_bodies_are_in_the_frame_of_their_common_centre() -> None:
    """1 kg at height 0.5 and 3 kg at 1.5: the centre is at 1.25."""
    q = axis_angle_quaternion([0, 0, 1], 0.3)
    lower = Body("a", "cube", (1, 2, 0), rotation=tuple(q.tolist()))  # type: ignore[arg-type]
    upper = Body("b", "cube", (1, 2, 1), mass=3.0)
    model = build_model(scene_of(lower, upper, joints=(Joint("a", "b"),)), RigidSettings())
    assert model.actors.count == 1
    assert model.actors.x[0].tolist() == pytest.approx([1, 2, 1.25])
    first, stop = model.hulls.first_vertex[:2]
    assert model.hulls.vertices[first:stop].mean(0).tolist() == pytest.approx([0, 0, -0.75])
    upper_corners = model.hulls.vertices[model.hulls.first_vertex[1] : model.hulls.first_vertex[2]]
    # Back in the world, the upper cube is upright.
    world = upper_corners @ rotation_matrices(model.actors.q[0]).T + model.actors.x[0]
    assert sorted(np.round(world, 9).tolist()) == [
        [x, y, z] for x in (0.5, 1.5) for y in (1.5, 2.5) for z in (1.0, 2.0)
    ]


def test_a_summary_has_one_contact_for_each_pair_and_frame() -> None:
    """Body 3 is the floor; columns are point, normal, impulse, gap."""
    frame = np.array([0, 0, 0, 2, 2])
    pair = np.array([[0, 1], [0, 3], [0, 1], [1, 0], [1, 0]])
    normal = [0.0, 0.0, 1.0]
    row = np.array(
        [
            [1, 0, 0, *normal, 0.1, -0.001],
            [2, 0, 0, *normal, 0.2, 0.0],
            [3, 0, 0, *normal, 0.4, -0.002],
            [4, 0, 0, *normal, 0.8, 0.003],
            [5, 0, 0, *normal, 1.6, 0.001],
        ]
    )
    found = summarise_contacts(frame, pair, row, 3)
    assert found.frame.tolist() == [0, 0, 2]
    assert found.bodies.tolist() == [[ENVIRONMENT, 0], [0, 1], [0, 1]]
    # The deepest point stands for the pair, with the impulse of all.
    assert found.point[:, 0].tolist() == [2, 3, 5]
    assert found.impulse.tolist() == pytest.approx([0.2, 0.5, 2.4])
    # Normals point from the first to the second of the sorted pair.
    assert found.normal[:, 2].tolist() == [-1, 1, -1]
    assert len(summarise_contacts(frame[:0], pair[:0], row[:0], 3).frame) == 0
