"""Mass properties against textbook formulas."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from physion.numerics.rotations import axis_angle_quaternion
from physion.physics.rigid.bodies import body_mass, center_of_mass, hull_mass, merge_masses
from physion.physics.rigid.engine import RigidEngine
from physion.scenes.scene import Body, Camera, Joint, Push, Roles, Scene
from physion.scenes.shapes.meshes import solid_properties
from physion.scenes.shapes.primitives import ball_mesh, shape


def box(
    center: tuple[float, float, float], size: tuple[float, float, float]
) -> NDArray[np.float64]:
    signs = np.array(list(itertools.product((-0.5, 0.5), repeat=3)))
    return np.asarray(signs * size + np.array(center))


def box_inertia(mass: float, size: tuple[float, float, float]) -> NDArray[np.float64]:
    squares = np.array(size) ** 2
    return np.diag(mass / 12 * (squares.sum() - squares))


def test_a_box() -> None:
    size = (0.2, 0.5, 1.5)
    found = hull_mass([box((1, 2, 3), size)], 3.0)
    assert found.mass == 3.0
    assert found.center.tolist() == pytest.approx([1, 2, 3])
    assert np.allclose(found.inertia, box_inertia(3.0, size), atol=1e-12)


def test_two_boxes_of_one_density() -> None:
    # Volumes 1 and 2: 1 kg at x = 0 and 2 kg at x = 3.
    small, large = (1.0, 1.0, 1.0), (2.0, 1.0, 1.0)
    found = hull_mass([box((0, 0, 0), small), box((3, 0, 0), large)], 3.0)
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


def test_nothing_is_a_point() -> None:
    found = hull_mass([], 2.0)
    assert found.center.tolist() == [0, 0, 0]
    assert found.inertia.tolist() == (2.0 * np.eye(3)).tolist()


def test_moved_and_merged_masses() -> None:
    size = (0.2, 0.5, 1.5)
    rotation = axis_angle_quaternion([0, 0, 1], math.pi / 2)
    found = hull_mass([box((1, 0, 0), size)], 3.0).moved(np.array([0.0, 0.0, 5.0]), rotation)
    assert found.center.tolist() == pytest.approx([0, 1, 5])
    assert np.allclose(found.inertia, box_inertia(3.0, (0.5, 0.2, 1.5)), atol=1e-12)
    halves = [hull_mass([box((0, 0, z), (1.0, 1.0, 0.5))], 1.0) for z in (0.25, 0.75)]
    whole = merge_masses(halves)
    assert whole.mass == 2.0
    assert np.allclose(whole.inertia, box_inertia(2.0, (1.0, 1.0, 1.0)), atol=1e-12)
