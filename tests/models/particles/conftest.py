"""Motions whose future is random, for the tests that no particle model sees it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from physion.clips.batch import LAST_OBSERVED, Motion, cut_to_observed

ARRAYS = (
    "positions", "rotations", "velocities", "angular_velocities", "cloth_vertices",
    "cloth_distance",
)  # fmt: skip


@pytest.fixture(scope="session")
def poisoned() -> Callable[[Motion], Motion]:
    """Return a function that gives a motion with random numbers after the observed part."""

    def poison(motion: Motion) -> Motion:
        scene, trajectory = motion.scene, motion.trajectory
        rng = np.random.default_rng(0)
        arrays = {name: getattr(trajectory, name).copy() for name in ARRAYS}
        for values in arrays.values():
            later = values[LAST_OBSERVED + 1 :]
            later[:] = rng.normal(size=later.shape)
        return Motion(
            scene,
            replace(
                trajectory,
                **arrays,
                contacts=cut_to_observed(scene, trajectory).contacts,
                completed=not trajectory.completed,
            ),
        )

    return poison
