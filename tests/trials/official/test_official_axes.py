"""Conversion of axes: positions, rotations and cameras agree in both systems."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from physion.core.errors import BadInputError
from physion.rendering.camera import View
from physion.scenes.scene import Camera
from physion.scenes.tdw.commands import quaternion_from_euler, vector
from physion.trials.official.names import (
    from_official_camera,
    from_official_rotation,
    rotation_matrices,
    swap_angular_velocity,
    swap_axes,
    to_official_camera,
    to_official_euler,
    to_official_rotation,
)

numbers = st.floats(-100, 100, allow_subnormal=False)
points = arrays(np.float64, 3, elements=numbers)
quaternions = (
    arrays(np.float64, 4, elements=st.floats(-1, 1))
    .filter(lambda q: np.linalg.norm(q) > 0.1)
    .map(lambda q: q / np.linalg.norm(q))
)


def turn_as_unity(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    """What a reader of official files computes: the textbook formula on (x, y, z, w)."""
    t = 2 * np.cross(q[:3], v)
    return v + q[3] * t + np.cross(q[:3], t)


@given(points)
def test_points_and_spins_come_back(p: np.ndarray) -> None:
    assert (swap_axes(swap_axes(p)) == p).all()
    assert (swap_angular_velocity(swap_angular_velocity(p)) == p).all()
    x, y, z = p
    assert tuple(swap_axes(p)) == vector({"x": x, "y": y, "z": z})


@given(quaternions)
def test_rotations_come_back(q: np.ndarray) -> None:
    assert (from_official_rotation(to_official_rotation(q)) == q).all()


@given(quaternions, points)
def test_turning_and_changing_axes_commute(q: np.ndarray, p: np.ndarray) -> None:
    turned_then_swapped = swap_axes(rotation_matrices(q) @ p)
    swapped_then_turned = turn_as_unity(to_official_rotation(q), swap_axes(p))
    np.testing.assert_allclose(turned_then_swapped, swapped_then_turned, atol=1e-9)


@given(points, points)
def test_a_spinning_point_moves_the_same_way(spin: np.ndarray, arm: np.ndarray) -> None:
    ours = swap_axes(np.cross(spin, arm))
    np.testing.assert_allclose(
        ours, np.cross(swap_angular_velocity(spin), swap_axes(arm)), atol=1e-9
    )


@settings(deadline=None)  # the first example imports the reader of logs
@given(quaternions)
def test_euler_angles_are_those_the_importer_of_logs_reads(q: np.ndarray) -> None:
    x, y, z = to_official_euler(q)
    back = np.array(quaternion_from_euler({"x": x, "y": y, "z": z}))
    np.testing.assert_allclose(rotation_matrices(back), rotation_matrices(q), atol=1e-6)


@pytest.mark.parametrize("pitch", [90.0, -90.0])
def test_euler_angles_straight_up_and_down(pitch: float) -> None:
    q = np.array(quaternion_from_euler({"x": pitch, "y": 30.0, "z": 20.0}))
    x, y, z = to_official_euler(q)
    back = np.array(quaternion_from_euler({"x": x, "y": y, "z": z}))
    np.testing.assert_allclose(rotation_matrices(back), rotation_matrices(q), atol=1e-6)


CAMERA = Camera((3.0, -1.0, 1.5), (0.2, 0.1, 0.4), math.radians(55))


def test_official_matrices_show_points_where_our_camera_does() -> None:
    world_to_camera, projection = to_official_camera(CAMERA, 80, 60)
    p = np.random.default_rng(0).uniform(-1, 1, (20, 3))
    clip = np.column_stack([swap_axes(p), np.ones(20)]) @ (projection @ world_to_camera).T
    assert (clip[:, 3] > 0).all()
    at = clip[:, :2] / clip[:, 3:]
    seen, depth = View(CAMERA, 80, 60).project(p)
    np.testing.assert_allclose((at[:, 0] + 1) / 2 * 80, seen[:, 0], atol=1e-9)
    np.testing.assert_allclose((1 - at[:, 1]) / 2 * 60, seen[:, 1], atol=1e-9)
    np.testing.assert_allclose(clip[:, 3], depth, atol=1e-9)


def test_official_camera_matrix_is_left_handed_as_the_real_ones() -> None:
    world_to_camera, projection = to_official_camera(CAMERA, 64, 64)
    assert np.linalg.det(world_to_camera[:3, :3]) == pytest.approx(-1)
    assert projection[1, 1] == pytest.approx(1.9209821)
    assert projection[3, 2] == -1


@given(points, points)
def test_cameras_come_back(eye: np.ndarray, aim: np.ndarray) -> None:
    if np.linalg.norm((eye - aim)[:2]) < 1:
        return
    camera = Camera(tuple(eye), tuple(aim))
    matrices = [m.astype(np.float32).astype(float) for m in to_official_camera(camera, 64, 64)]
    back, upright = from_official_camera(matrices[0], matrices[1], aim)
    assert upright
    np.testing.assert_allclose(back.position, eye, atol=2e-4)
    np.testing.assert_allclose(back.target, aim, atol=2e-4)
    assert (back.near, back.far) == (0.1, 100.0)
    assert back.fov == pytest.approx(camera.fov, abs=1e-6)


def test_a_tilted_camera_is_told_from_an_upright_one() -> None:
    world_to_camera, projection = to_official_camera(CAMERA, 64, 64)
    turn = np.eye(4)
    turn[:2, :2] = [[0.8, -0.6], [0.6, 0.8]]
    _, upright = from_official_camera(turn @ world_to_camera, projection, (0, 0, 0))
    assert not upright


@pytest.mark.parametrize("broken", [0, 1])
def test_what_is_no_camera_is_refused(broken: int) -> None:
    matrices = list(to_official_camera(CAMERA, 64, 64))
    matrices[broken] = np.zeros((4, 4))
    with pytest.raises(BadInputError):
        from_official_camera(matrices[0], matrices[1], (0, 0, 0))
