"""Graph of the particle simulators: its edges by the two searches for neighbours."""

from __future__ import annotations

import pytest
import torch

from physion import sample_scene
from physion.clips.batch import Motion
from physion.models.particles.bodies import Sampling, poses_of, scene_particles
from physion.models.particles.networks import (
    drift_of,
    join_poses,
    join_scenes,
    outer_edges,
    outer_edges_on_device,
)
from physion.physics.engine import simulate

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
