"""Trained weights of particle models in the package, on scenes that they never saw."""

from __future__ import annotations

import numpy as np
import pytest

from physion import sample_scene
from physion.clips.batch import Motion, cut_to_observed
from physion.models.build import build_model
from physion.models.particles.simulator import ParticleSimulator
from physion.physics.engine import simulate
from physion.readout.rollout_error import motion_error

NAMES = ("gns", "gns-ransac", "dpi")
SCENARIOS = ("collide", "contain", "drop", "roll")
SCENES = 4
HORIZON = 60
"""Frames after the last observed one."""


@pytest.fixture(scope="module")
def motions() -> list[Motion]:
    scenes = [sample_scene(name, 9000 + seed) for name in SCENARIOS for seed in range(SCENES)]
    return [Motion(scene, simulate(scene)) for scene in scenes]


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_weights_predict_motion(name: str, motions: list[Motion]) -> None:
    """The error after 0.6 s is at most half of that of constant velocity; random weights fail."""
    cut = [Motion(m.scene, cut_to_observed(m.scene, m.trajectory)) for m in motions]

    def error_of(weights: str) -> float:
        model = build_model(name, weights=weights)
        assert isinstance(model, ParticleSimulator)
        futures = model.futures(cut, 1, 0)
        rows = [
            motion_error(motion, particles, poses, model.spec.stride, HORIZON).iloc[-1]
            for motion, ((particles, poses),) in zip(motions, futures, strict=True)
        ]
        errors, constant = (
            np.mean([row[column] for row in rows])
            for column in ("Error", "Constant Velocity Error")
        )
        return float(errors / constant)

    assert error_of("shipped") < 0.5 < error_of("random")
