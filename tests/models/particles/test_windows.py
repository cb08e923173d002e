"""Which windows of a trial particle models are trained on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from physion import sample_scene
from physion.models.particles.rollout import start_probabilities
from physion.physics.engine import simulate
from physion.physics.trajectory import Trajectory

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


def test_what_gravity_alone_does_is_not_abrupt(calm: Trajectory) -> None:
    falling = calm.velocities.copy()
    falling[:, 0, 2] = -9.81 * 0.01 * np.arange(len(falling))
    found = start_probabilities(replace(calm, velocities=falling), STRIDE, LENGTH, ABRUPT)
    assert np.ptp(found) == 0


def test_a_short_trial_has_one_start(calm: Trajectory) -> None:
    names = ("positions", "rotations", "velocities", "angular_velocities", "cloth_vertices")
    short = replace(calm, **{name: getattr(calm, name)[:5] for name in names},
                    cloth_distance=calm.cloth_distance[:5])  # fmt: skip
    assert start_probabilities(short, STRIDE, LENGTH, ABRUPT).tolist() == [1.0]
