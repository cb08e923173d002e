"""Distances of imagined bodies, windows for training, and graphs of scenes."""

from __future__ import annotations

import dataclasses
from dataclasses import replace

import numpy as np
import pytest
import torch

from physion import sample_scene
from physion.clips.batch import Motion
from physion.models.particles.bodies import (
    Poses,
    Sampling,
    SceneParticles,
    poses_of,
    scene_particles,
)
from physion.models.particles.networks import (
    drift_of,
    join_poses,
    join_scenes,
    outer_edges,
    outer_edges_on_device,
)
from physion.models.particles.rollout import FAR, TOLERANCE, smallest_distance, start_probabilities
from physion.physics.engine import simulate
from physion.physics.trajectory import Trajectory
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


# Which windows of a trial particle models are trained on.

STRIDE, LENGTH, ABRUPT = 3, 4, 0.5
JUMP = 60
"""First frame after which a body moves with another velocity."""


@pytest.fixture(scope="module")
def calm() -> Trajectory:
    """Return a motion whose velocities are constant."""
    motion = simulate(sample_scene("collide", 3))
    still = np.zeros_like(motion.velocities)
    return replace(motion, velocities=still, angular_velocities=still.copy())


def test_without_contacts_all_starts_are_equally_frequent(calm: Trajectory) -> None:
    found = start_probabilities(calm, STRIDE, LENGTH, ABRUPT)
    assert len(found) == len(calm.positions) - (LENGTH - 1) * STRIDE
    assert np.ptp(found) == 0 and found.sum() == pytest.approx(1)


@pytest.mark.parametrize("spin", [False, True])
def test_a_jump_of_the_velocity_is_predicted_by_half_of_the_windows(
    calm: Trajectory, spin: bool
) -> None:
    """The jump lies within the predicted steps, frames 3 to 9 of a window."""
    name = "angular_velocities" if spin else "velocities"
    values = getattr(calm, name).copy()
    values[JUMP + 1 :, 0, 0] = 10.0
    found = start_probabilities(replace(calm, **{name: values}), STRIDE, LENGTH, ABRUPT)
    starts = np.arange(len(found))
    holds = (starts + STRIDE <= JUMP) & (starts + (LENGTH - 1) * STRIDE > JUMP)
    rest = (1 - ABRUPT) / len(found)
    np.testing.assert_allclose(found[~holds], rest)
    np.testing.assert_allclose(found[holds], rest + ABRUPT / holds.sum())


def test_what_only_gravity_does_is_not_abrupt(calm: Trajectory) -> None:
    falling = calm.velocities.copy()
    falling[:, 0, 2] = -9.81 * 0.01 * np.arange(len(falling))
    found = start_probabilities(replace(calm, velocities=falling), STRIDE, LENGTH, ABRUPT)
    assert np.ptp(found) == 0


def test_a_short_trial_has_one_start(calm: Trajectory) -> None:
    names = ("positions", "rotations", "velocities", "angular_velocities", "cloth_vertices")
    short = replace(calm, **{name: getattr(calm, name)[:5] for name in names},
                    cloth_distance=calm.cloth_distance[:5])  # fmt: skip
    assert start_probabilities(short, STRIDE, LENGTH, ABRUPT).tolist() == [1.0]


# Graph of the particle simulators: its edges by the two searches for neighbours.

CPU = torch.device("cpu")


@pytest.mark.parametrize("swept", [True, False])
def test_a_device_gets_the_edges_of_the_cpu(swept: bool) -> None:
    """Also of two scenes in one place, with bodies at rest, kinematic ones and a cloth."""
    motions = []
    for scenario, seed in (("collide", 3), ("drape", 1)):
        scene = sample_scene(scenario, seed)
        motions.append(Motion(scene, simulate(scene)))
    particles = [scene_particles(m.scene, Sampling()) for m in motions]
    poses = [poses_of(p, m, [41, 44]) for p, m in zip(particles, motions, strict=True)]
    layout = join_scenes(particles, CPU)
    drift = drift_of(layout, join_poses(poses, 0, CPU), join_poses(poses, 1, CPU))
    moves = drift.moves if swept else torch.zeros_like(drift.moves)
    expected = outer_edges(layout, drift.positions, moves, 0.3)
    edges = outer_edges_on_device(layout, drift.positions, moves, 0.3)
    assert expected.shape[1] > 100 and torch.equal(edges, expected)
    scenes = layout.scene[layout.owners[edges[0]]].tolist()
    assert set(scenes) == {0, 1}, "both scenes have edges"
