"""Levels of noise that were fitted to recorded outcomes or to people's answers.

`benchmarks/models/noise.py` divided the official configurations into two halves and fitted
the levels on each. A scene gets the levels that were fitted on the half without its
configuration, so that no prediction of an official scene rests on its own outcome, or on
answers to it.
"""

from __future__ import annotations

from collections.abc import Mapping

from physion.models.state_noise import NoiseLevels
from physion.scenes.scene import Scene
from physion.seeds import stable_hash

FITTED: Mapping[str, tuple[NoiseLevels, NoiseLevels]] = {
    "outcomes": (NoiseLevels(lapse=0.1), NoiseLevels(vertical=0.01, contact=0.4)),
    "people": (
        NoiseLevels(
            position=0.05, velocity=0.2, vertical=0.05, rotation=0.2, contact=0.1, lapse=0.26
        ),
        NoiseLevels(vertical=0.01, contact=0.4, lapse=0.22),
    ),
}
"""By what they were fitted to: levels fitted on half 0 and on half 1, from
benchmarks/results/noise.md."""


def configuration_half(scene: Scene) -> int:
    """Return the half, 0 or 1, of a scene's configuration, by the hash of its name.

    A scene without a configuration, which is not official, counts by its own name.
    """
    return stable_hash("half", str(scene.parameters.get("configuration", scene.name))) % 2


def fitted_levels(target: str, scene: Scene) -> NoiseLevels:
    """Return the levels fitted to ``target`` on the half without the scene's configuration."""
    return FITTED[target][1 - configuration_half(scene)]
