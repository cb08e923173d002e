"""Settings of OP3, and its sizes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from physion.errors import BadInputError
from physion.models.settings import TrainingSettings
from physion.models.vision.model import VisionOptions


@dataclass(frozen=True, slots=True)
class Op3Options(VisionOptions):
    """What a user chooses of OP3; also see `VisionOptions`.

    - ``slots``: by default (0) those of the size. Weights fit any number of slots.
    - ``samples``: futures of a trial, whose features the readout joins.
    """

    slots: int = 0
    samples: int = 1

    def __post_init__(self) -> None:
        # Not super(): a dataclass with slots is made anew, which super() does not know.
        VisionOptions.__post_init__(self)
        for name, least in (("slots", 0), ("samples", 1)):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < least:
                raise BadInputError(f"{name} must be a whole number from {least} on, not {value!r}")


_COUNTS = (
    "image_size", "slots", "deterministic", "stochastic", "width", "layers", "step", "hidden",
    "effect", "seed_steps", "past", "imagined", "stride", "context",
)  # fmt: skip
"""Settings that must be at least 1."""


@dataclass(frozen=True, slots=True)
class Op3Config:
    """All settings of OP3.

    - ``image_size``: pixels per side. ``slots``: K.
    - ``deterministic``, ``stochastic``: sizes of the two parts of the state of a slot.
    - ``width``: channels of the convolutions, with ``kernel`` x ``kernel`` weights; ``layers`` of
      the decoder; ``step``, the stride of those of the refinement.
    - ``hidden``: units of the refinement's LSTM. ``effect``: size of the effect of one slot on
      another.
    - ``update``: whether refinement and dynamics ``add`` to the state or ``replace`` it, as in the
      published code.
    - ``density``: of a pixel given a slot: ``gaussian``, or ``released``, that of the published
      code (`op3.pixels`), with the standard deviation ``sigma``.
    - ``beta``: weight of the divergence.
    - ``motion``: additional weight of moving pixels in the loss; published 0. Few pixels move, and
      a short training would learn the scenery alone.
    - ``seed_steps``: refinements with the first frame; each later one that is seen has one.
    - ``past``, ``imagined``: frames of a training clip that are seen, and that follow.
    - ``stride``, ``context``, ``future``: see `physion.models.batch.Spec`.
    - ``training``: optimiser and schedule.
    """

    image_size: int = 32
    slots: int = 5
    deterministic: int = 16
    stochastic: int = 16
    width: int = 16
    kernel: int = 3
    layers: int = 4
    step: int = 2
    hidden: int = 64
    effect: int = 32
    update: Literal["add", "replace"] = "add"
    density: Literal["gaussian", "released"] = "gaussian"
    sigma: float = 0.1
    beta: float = 1e-2
    motion: float = 20.0
    seed_steps: int = 3
    past: int = 4
    imagined: int = 3
    stride: int = 6
    context: int = 7
    future: int = 18
    training: TrainingSettings = field(default_factory=TrainingSettings)

    def __post_init__(self) -> None:
        for name in _COUNTS:
            if getattr(self, name) < 1:
                raise BadInputError(f"OP3: {name} must be at least 1, not {getattr(self, name)}")
        if self.layers < 2 or self.kernel % 2 == 0:
            raise BadInputError(
                f"OP3: layers must be at least 2 and kernel odd, not {self.layers} and "
                f"{self.kernel}"
            )


_SMALL = TrainingSettings(
    steps=3000,
    batch=8,
    learning_rate=1e-3,
    schedule="cosine",
    warmup=100,
    clip=5.0,
    validate_every=500,
    log_every=50,
    checkpoint_every=500,
)
# Published for Physion, before the paper: 300 epochs, whose length is not known.
_PAPER = replace(
    _SMALL, steps=180_000, batch=16, learning_rate=3e-4, schedule="constant", warmup=0,
    validate_every=600,
)  # fmt: skip


def op3_config(options: Op3Options) -> Op3Config:
    """Return the settings of a size."""
    config = Op3Config(training=_SMALL)
    if options.size != "small":
        config = Op3Config(
            image_size=64,
            slots=8,
            deterministic=64,
            stochastic=64,
            width=32,
            kernel=5,
            layers=5,
            step=1,
            hidden=128,
            motion=0.0,
            update="replace",
            density="released" if options.size == "released" else "gaussian",
            seed_steps=4,
            training=_PAPER,
        )
    return replace(config, slots=options.slots or config.slots)
