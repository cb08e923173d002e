"""Settings of the particle models, and their sizes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from physion.core.errors import BadInputError
from physion.models.interface import TrainingSettings
from physion.models.particles.bodies import ParticleSettings

Size = Literal["small", "paper", "released"]
RANDOM, SHIPPED = "random", "shipped"


@dataclass(frozen=True, slots=True)
class ParticleOptions:
    """What a user chooses of a particle model.

    - ``size``: ``small`` or ``paper`` of this package's own form, or ``released``, the networks,
      inputs and decision of the published code (`released.simulator`).
    - ``weights``: ``random``, to be trained; ``shipped``, those that come with the package,
      trained on all scenarios; or the path of a ``model.safetensors`` that ``physion train`` wrote,
      or of its folder.
    - ``swept``: whether particles that come close during a step are neighbours; those of the size
      released never are.
    - ``samples``: futures of a trial, and ``spread``: standard deviation of the noise on their
      initial velocities, m/s. One future has no noise.
    - ``stride``: frames of 0.01 s in one step.
    - ``seed``: of initial weights, and of the noise of futures.
    """

    size: Size = "small"
    weights: str = RANDOM
    swept: bool = True
    samples: int = 1
    spread: float = 0.05
    stride: int = 3
    seed: int = 0

    def __post_init__(self) -> None:
        if self.size not in ("small", "paper", "released"):
            raise BadInputError(
                f"a particle model has the sizes small, paper and released, not {self.size!r}"
            )
        if isinstance(self.samples, bool) or not isinstance(self.samples, int) or self.samples < 1:
            raise BadInputError(f"samples must be a whole number from 1 on, not {self.samples!r}")
        if self.stride not in (1, 3):
            raise BadInputError(f"stride must be 1 or 3 frames, not {self.stride!r}")
        if not self.spread >= 0:
            raise BadInputError(f"spread must not be negative, not {self.spread!r}")


@dataclass(frozen=True, slots=True)
class ParticleConfig:
    """All settings of a particle model of this package's own form.

    - ``network``: ``messages`` (GNS) or ``objects`` (DPI-Net), with ``width`` and ``rounds``.
    - ``particles``: how objects become particles.
    - ``radius``: metres within which particles of different objects are neighbours; with ``swept``
      also those that come so close during a step.
    - ``rigid``: how GNS keeps bodies rigid: ``fit`` to all particles, or ``robust`` (RANSAC).
    - ``velocity_noise``, ``relative_noise``: metres a step, and fraction of the speed; standard
      deviations of the noise in training, drawn for every rigid body and for every particle of a
      cloth. Noise that is large beside a slow motion teaches that it stops.
    - ``pushforward``: steps that follow the first one in training. They start from what the network
      predicted, without gradient, so that it learns to correct its own errors (Brandstetter et al.
      2022, section 3.1).
    - ``abrupt``: fraction of the training windows that are drawn from moments at which bodies
      change their velocity abruptly, as at contacts (`windows.start_probabilities`); the others
      are drawn from all moments.
    - ``rest``: metres a step; in a rollout a body whose centre and rim would move less together
      stays where it is, as bodies sleep in physics engines. Otherwise small errors, which add up as
      a velocity, tip what stands.
    - ``knee``: errors of an object count squared up to this many units (``simulator.CHANGE``), and
      linearly beyond.
    - ``gap_spacing``, ``gap_limit``: of the particles by which distances are measured.
    - ``training``: optimiser and schedule.
    """

    network: Literal["messages", "objects"]
    width: int = 64
    rounds: int = 3
    particles: ParticleSettings = field(default_factory=ParticleSettings)
    radius: float = 0.12
    swept: bool = True
    rigid: Literal["fit", "robust"] = "fit"
    velocity_noise: float = 3e-4
    relative_noise: float = 0.02
    pushforward: int = 1
    abrupt: float = 0.5
    rest: float = 3e-4
    knee: float = 1.0
    gap_spacing: float = 0.04
    gap_limit: int = 300
    training: TrainingSettings = field(default_factory=TrainingSettings)


_SMALL = TrainingSettings(
    steps=3000,
    batch=24,
    learning_rate=2e-3,
    schedule="cosine",
    warmup=100,
    clip=0.0,
    validate_every=500,
    log_every=50,
    checkpoint_every=500,
)
_PAPER = replace(_SMALL, steps=500_000, learning_rate=5e-4, warmup=2000, validate_every=5000)
_FINE = ParticleSettings(spacing=0.05, limit=1000, cloth_step=1)


def own_config(network: Literal["messages", "objects"], options: ParticleOptions) -> ParticleConfig:
    """Return the settings of the sizes ``small`` and ``paper``."""
    inner = network == "messages"
    if options.size == "small":
        config = ParticleConfig(
            network,
            rounds=5 if inner else 3,
            particles=ParticleSettings(limit=50, inner=6) if inner else ParticleSettings(),
            training=_SMALL,
        )
    else:
        config = ParticleConfig(
            network,
            width=128,
            rounds=10 if inner else 4,
            particles=replace(_FINE, inner=10 if inner else 0),
            radius=0.08,
            gap_spacing=0.03,
            gap_limit=1000,
            training=_PAPER,
        )
    # A step of fewer frames is shorter, and so is what is counted in metres a step.
    part = options.stride / 3
    return replace(
        config,
        swept=options.swept,
        velocity_noise=config.velocity_noise * part,
        rest=config.rest * part,
    )
