"""Settings of the published particle models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from physion.models.interface import TrainingSettings
from physion.models.particles.bodies import ParticleSettings
from physion.models.particles.config import ParticleConfig
from physion.models.particles.released.dpi import STEPS as DPI_STEPS
from physion.models.particles.released.gns import STEPS as GNS_STEPS
from physion.physics.particles import CLOTH_SPACING, LIMIT, SPACING

RADIUS = 0.08
"""Metres within which particles are neighbours: ``neighbor_radius`` of train.py."""
NOISE = 3e-4
"""``noise_std`` of train.py, m/s; see `ReleasedSimulator`."""
ROLLOUT_LIMIT = 1000
"""Largest number of particles of a body in rollouts: ``--subsample`` of scripts/eval_*.sh."""


@dataclass(frozen=True, slots=True)
class ReleasedConfig(ParticleConfig):
    """All settings of a published particle model; other fields of `ParticleConfig` are not used.

    - ``network``, ``width``, ``rounds``: `ReleasedGNS` or `ReleasedDPI`; ``width`` of particles and
      effects, relations have half as much again.
    - ``particles``: in training. ``rollout_limit``: of the particles of a body in rollouts.
    - ``velocity_noise``: m/s, not metres a step.
    - ``keep_rigid``: whether each step ends with the rigid motion that fits a body best.
    """

    rollout_limit: int = ROLLOUT_LIMIT
    keep_rigid: bool = False


_PARTICLES = ParticleSettings(
    spacing=SPACING,
    limit=LIMIT,
    still_limit=LIMIT,
    fill="volume",
    cloth_step=1,
    cloth_spacing=CLOTH_SPACING,
)
# Published: 1.5 to 2 million windows, one at a time, a step after every second; validation after an
# epoch of about 13,500 windows.
_TRAINING = TrainingSettings(
    steps=750_000,
    batch=1,
    accumulate=2,
    learning_rate=1e-4,
    betas=(0.9, 0.999),
    schedule="plateau",
    plateau_factor=0.8,
    plateau_patience=3,
    held_out=0.1,
    validate_every=6750,
    log_every=100,
    checkpoint_every=2500,
)


def released_config(
    network: Literal["messages", "objects"], *, keep_rigid: bool = False
) -> ReleasedConfig:
    """Return the published settings."""
    return ReleasedConfig(
        network,
        width=200,
        rounds=GNS_STEPS if network == "messages" else DPI_STEPS,
        particles=_PARTICLES,
        radius=RADIUS,
        swept=False,
        velocity_noise=NOISE,
        pushforward=0,
        abrupt=0.0,
        training=_TRAINING,
        keep_rigid=keep_rigid,
    )
