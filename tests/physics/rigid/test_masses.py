"""Hulls of shapes, masses and inertias against textbook formulas, and the summary of contacts."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from physion.numerics.rotations import axis_angle_quaternion, rotation_matrices
from physion.physics.rigid.bodies import (
    RigidSettings,
    body_mass,
    build_model,
    center_of_mass,
    collision_hulls,
    find_actors,
    hull_faces,
    hull_mass,
    inner_box,
    merge_masses,
)
from physion.physics.rigid.engine import RigidEngine
from physion.physics.trajectory import ENVIRONMENT, summarise_contacts
from physion.scenes.scene import Body, Camera, Joint, Push, Roles, Scene
from physion.scenes.shapes.meshes import solid_properties
from physion.scenes.shapes.primitives import ball_mesh, shape
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


@pytest.mark.slow
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


def box_at(
    center: tuple[float, float, float], size: tuple[float, float, float]
) -> NDArray[np.float64]:
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    return np.asarray(signs * size + np.array(center))


def box_inertia(mass: float, size: tuple[float, float, float]) -> NDArray[np.float64]:
    squares = np.array(size) ** 2
    return np.diag(mass / 12 * (squares.sum() - squares))


def test_a_box() -> None:
    size = (0.2, 0.5, 1.5)
    found = hull_mass([box_at((1, 2, 3), size)], 3.0)
    assert found.mass == 3.0
    assert found.center.tolist() == pytest.approx([1, 2, 3])
    assert np.allclose(found.inertia, box_inertia(3.0, size), atol=1e-12)


def test_two_boxes_of_one_density() -> None:
    # Volumes 1 and 2: 1 kg at x = 0 and 2 kg at x = 3.
    small, large = (1.0, 1.0, 1.0), (2.0, 1.0, 1.0)
    found = hull_mass([box_at((0, 0, 0), small), box_at((3, 0, 0), large)], 3.0)
    assert found.center.tolist() == pytest.approx([2, 0, 0])
    parallel = np.diag([0.0, 1.0, 1.0]) * (1.0 * 2.0**2 + 2.0 * 1.0**2)
    expected = box_inertia(1.0, small) + box_inertia(2.0, large) + parallel
    assert np.allclose(found.inertia, expected, atol=1e-12)


def test_a_ball_of_ever_more_facets_tends_to_two_fifths_of_m_r_squared() -> None:
    errors = []
    for segments in (16, 32, 64):
        found = hull_mass([ball_mesh(0.5, segments).vertices], 2.0)
        assert np.allclose(found.center, 0, atol=1e-12)
        expected = 0.4 * 2.0 * 0.5**2
        errors.append(1 - np.diagonal(found.inertia) / expected)
        assert (errors[-1] > 0).all()
    # Inscribed facets: the error falls with the square of their number.
    assert errors[0].max() < 0.06
    assert np.allclose(errors[0] / errors[1], 4, rtol=0.1)
    assert np.allclose(errors[1] / errors[2], 4, rtol=0.1)


def test_a_bowl_has_its_centre_in_the_wall_pieces_not_in_the_drawn_solid() -> None:
    bowl = Body("a", "bowl", (0, 0, 0), (1.0, 1.0, 1.0))
    drawn = solid_properties(shape("bowl").mesh)[1]
    engine = body_mass(bowl).center
    assert engine[:2].tolist() == pytest.approx([0, 0], abs=1e-9)
    assert abs(engine[2] - drawn[2]) > 1e-4


@pytest.mark.parametrize("name", ["bowl", "pipe"])
def test_a_push_without_a_point_acts_at_the_centre_of_mass(name: str) -> None:
    """The same impulse at `center_of_mass` moves the body in the same way, without spin."""
    rotation = tuple(axis_angle_quaternion([1, 2, 3], 0.7).tolist())
    body = Body("a", name, (0.3, -0.2, 5.0), (0.4, 0.5, 0.6), rotation, mass=2.0)
    zone = Body("zone", "cube", (9.0, 9.0, 0.0), (1, 1, 0.01), kinematic=True)
    roles = Roles("a", "zone")
    scene = Scene("t", "t", (body, zone), roles, Camera((0, -3, 1)), pushes=(Push("a", (3, 1, 2)),))
    point = tuple(center_of_mass(scene, "a").tolist())
    paths = [
        RigidEngine().simulate(replace(scene, pushes=(push,)), frames=3)
        for push in (scene.pushes[0], replace(scene.pushes[0], point=point))
    ]
    assert np.allclose(paths[0].velocities, paths[1].velocities, atol=1e-6)
    assert np.abs(paths[1].angular_velocities).max() < 1e-6


def test_a_joined_body_is_pushed_at_the_common_centre() -> None:
    base = Body("a", "cube", (0, 0, 0), (1, 1, 1), mass=3.0)
    top = Body("b", "cube", (0, 0, 1.0), (1, 1, 1), mass=1.0)
    zone = Body("zone", "cube", (9.0, 9.0, 0.0), (1, 1, 0.01), kinematic=True)
    bodies, joints = (base, top, zone), (Joint("a", "b"),)
    scene = Scene("t", "t", bodies, Roles("a", "zone"), Camera((0, -3, 1)), joints=joints)
    assert center_of_mass(scene, "b").tolist() == pytest.approx([0, 0, 0.75])
    assert center_of_mass(scene, "zone").tolist() == pytest.approx([9, 9, 0.005])


def test_joined_bodies_with_a_turned_leader_keep_centre_and_inertia() -> None:
    """The pair's centre and inertia in the world, by the parallel axis theorem."""
    turns = Rotation.random(2, rng=np.random.default_rng(3))
    sizes, places = np.array([[0.4, 0.3, 0.2], [0.1, 0.2, 0.6]]), np.array([[1, 2, 3], [1.5, 2, 4]])
    masses = np.array([3.0, 1.0])
    bodies = tuple(
        Body(name, "cube", tuple(at), tuple(size), (q[3], *q[:3]), mass=mass)
        for name, at, size, q, mass in zip(
            "ab", places, sizes, turns.as_quat(), masses, strict=True
        )
    )
    camera = Camera((0, -3, 1))
    scene = Scene("t", "t", bodies, Roles("a", "b"), camera, joints=(Joint("a", "b"),))
    # A cube's pivot is the centre of its bottom face.
    centers = places + turns.apply(sizes * [0, 0, 0.5])
    center = masses @ centers / masses.sum()
    inertia = np.zeros((3, 3))
    for mass, size, turn, own in zip(masses, sizes, turns, centers, strict=True):
        rotated = turn.as_matrix() @ box_inertia(mass, tuple(size)) @ turn.as_matrix().T
        arm = own - center
        inertia += rotated + mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    actors = find_actors(scene)
    assert actors.mass.tolist() == [4.0]
    np.testing.assert_allclose(actors.x[0], center, atol=1e-12)
    frame = turns[0].as_matrix()
    np.testing.assert_allclose(frame @ actors.inertia[0] @ frame.T, inertia, atol=1e-12)
    for i, turn in enumerate(turns):
        np.testing.assert_allclose(center + frame @ actors.pivot[i], places[i], atol=1e-12)
        np.testing.assert_allclose(center + frame @ actors.center[i], centers[i], atol=1e-12)
        relative = Rotation.from_quat(np.roll(actors.rotation[i], -1))
        np.testing.assert_allclose((turns[0] * relative).as_matrix(), turn.as_matrix(), atol=1e-12)
    path = RigidEngine().simulate(scene, frames=1)
    np.testing.assert_allclose(path.positions[0], places - [0, 0, 9.81e-4], atol=1e-6)


def test_nothing_is_a_point() -> None:
    found = hull_mass([], 2.0)
    assert found.center.tolist() == [0, 0, 0]
    assert found.inertia.tolist() == (2.0 * np.eye(3)).tolist()


def test_moved_and_merged_masses() -> None:
    size = (0.2, 0.5, 1.5)
    rotation = axis_angle_quaternion([0, 0, 1], math.pi / 2)
    found = hull_mass([box_at((1, 0, 0), size)], 3.0).moved(np.array([0.0, 0.0, 5.0]), rotation)
    assert found.center.tolist() == pytest.approx([0, 1, 5])
    assert np.allclose(found.inertia, box_inertia(3.0, (0.5, 0.2, 1.5)), atol=1e-12)
    halves = [hull_mass([box_at((0, 0, z), (1.0, 1.0, 0.5))], 1.0) for z in (0.25, 0.75)]
    whole = merge_masses(halves)
    assert whole.mass == 2.0
    assert np.allclose(whole.inertia, box_inertia(2.0, (1.0, 1.0, 1.0)), atol=1e-12)
