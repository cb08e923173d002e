"""Smallest distance of agent and patient: closed forms, absent objects, cloth."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from physion.models.particles.bodies import Poses, Sampling, SceneParticles, scene_particles
from physion.models.particles.rollout import FAR, TOLERANCE, smallest_distance
from physion.scenes.scene import Cloth, Scene
from support.rendered_scenes import body, scene_of


def poses(*centers: tuple[float, float, float], rows: int = 1) -> Poses:
    """Return a motion in which objects stay at their centres."""
    shape = (rows, len(centers), 3)
    rotations = np.broadcast_to(np.eye(3), (*shape, 3)).copy()
    where = np.broadcast_to(np.array(centers, float), shape).copy()
    return Poses(where, rotations, np.zeros((rows, 0, 3)))


def two_cubes() -> tuple[Scene, SceneParticles]:
    scene = scene_of(body("a", scale=(1.0, 1.0, 1.0)), body("b", scale=(1.0, 1.0, 1.0)))
    own = scene_particles(scene, Sampling())
    # Centres are those of the particles; here they are to be those of the cubes.
    middle = np.array([0.0, 0.0, 0.5])
    return scene, dataclasses.replace(own, pivots=np.stack([middle, middle]))


@pytest.mark.parametrize("apart", [-0.4, -0.1, 0.0, 0.05, 2.0])
def test_cubes_face_to_face(apart: float) -> None:
    scene, own = two_cubes()
    found = smallest_distance(scene, own, poses((0, 0, 0), (1 + apart, 0.2, 0.1)), 0.1, 100)
    assert found == pytest.approx(apart, abs=TOLERANCE)


def test_a_cube_that_flies_past_between_two_frames() -> None:
    scene, own = two_cubes()
    motion = poses((0, 0, 0), (0, 0, 0), rows=2)
    motion.centers[:, 1] = [[-4, 1.3, 0], [4, 1.3, 0]]
    assert smallest_distance(scene, own, motion, 0.1, 100) == pytest.approx(0.3, abs=TOLERANCE)
    motion.centers[:, 1] = [[-4, 0.3, 0], [4, 0.3, 0]]
    assert smallest_distance(scene, own, motion, 0.1, 100) <= 0


def test_a_corner_that_comes_closest_between_two_frames() -> None:
    """In the middle of a quarter turn the corner of a unit cube is sqrt(1/2) from its centre."""
    scene, own = two_cubes()
    motion = poses((0, 0, 0), (1.5, 0, 0), rows=2)
    motion.rotations[1, 1] = [[0.0, -1, 0], [1, 0, 0], [0, 0, 1]]
    found = smallest_distance(scene, own, motion, 0.1, 100)
    assert found == pytest.approx(1.0 - np.sqrt(0.5), abs=2 * TOLERANCE)


def test_an_absent_object_is_far() -> None:
    scene, _ = two_cubes()
    own = scene_particles(scene, Sampling(), (True, False))
    assert smallest_distance(scene, own, poses((0, 0, 0)), 0.1, 100) == FAR


def test_a_cloth_above_a_cube() -> None:
    cloth = Cloth("sheet", (0.0, 0.0, 1.0), size=(1.0, 1.0, 0.0), resolution=11)
    scene = scene_of(body("a", scale=(1.0, 1.0, 1.0)), cloths=[cloth])
    own = scene_particles(scene, Sampling(cloth_step=2))
    top = own.shape[own.owners == 0, 2].max()
    grid = np.linspace(-0.5, 0.5, 6)
    x, y = np.meshgrid(grid, grid, indexing="ij")
    sheet = np.stack([x, y, np.full_like(x, top + 0.3)], -1).reshape(1, -1, 3)
    motion = dataclasses.replace(poses((0, 0, 0), (0, 0, 1)), loose=sheet)
    found = smallest_distance(scene, own, motion, 0.05, 1000)
    assert 0.3 - 1e-9 <= found <= np.hypot(0.3, 0.05), "above points that are at most 0.05 m aside"
