"""Settings of C-SWM, and its sizes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from physion.models.settings import TrainingSettings
from physion.models.vision.model import Size


@dataclass(frozen=True, slots=True)
class CswmConfig:
    """All settings of C-SWM.

    - ``image_size``: pixels per side. ``stacked``: successive pictures that make one state.
    - ``memory``: states from which the next one is predicted: 1, or 2, the present one and its
      change.
    - ``slots``: number of slots K, with ``slot_size`` values each. ``hidden``: units of the hidden
      layers.
    - ``channels``: of the first convolution. ``kernels``: sizes of the two convolutions, and
      ``strides``. The first one is padded, the second is not.
    - ``sigma``: unit of distances in the energy. ``hinge``: energy from which a negative is far
      enough.
    - ``transitions``: pairs of successive states in a training clip.
    - ``negatives``: ``all`` other states of the batch (`contrast.all_pairs_loss`); or ``permuted``,
      as published: one state each, in a random order that may leave it in its place. Clips differ
      in their objects, so that without other steps the slots need not follow any motion.
    - ``training``: optimiser and schedule.
    """

    image_size: int = 64
    stacked: int = 1
    memory: int = 2
    slots: int = 6
    slot_size: int = 32
    hidden: int = 128
    channels: int = 16
    kernels: tuple[int, int] = (5, 2)
    strides: tuple[int, int] = (2, 2)
    sigma: float = 0.5
    hinge: float = 1.0
    transitions: int = 3
    negatives: Literal["all", "permuted"] = "all"
    training: TrainingSettings = field(default_factory=TrainingSettings)


_SMALL = CswmConfig(
    training=TrainingSettings(
        steps=6000,
        batch=32,
        learning_rate=1e-3,
        schedule="cosine",
        warmup=50,
        validate_every=250,
        log_every=25,
        checkpoint_every=250,
    )
)
_PAPER = CswmConfig(
    image_size=224,
    slots=10,
    slot_size=128,
    hidden=512,
    channels=32,
    kernels=(9, 5),
    strides=(1, 5),
    training=replace(_SMALL.training, steps=100_000, learning_rate=5e-4, warmup=1000),
)
_RELEASED = replace(
    _PAPER,
    stacked=7,
    memory=1,
    transitions=1,
    negatives="permuted",
    # The published code makes a new Adam at every step, which equals betas of 0.
    training=replace(_PAPER.training, schedule="constant", warmup=0, betas=(0.0, 0.0)),
)
_SIZES: dict[Size, CswmConfig] = {"small": _SMALL, "paper": _PAPER, "released": _RELEASED}


def cswm_config(size: Size) -> CswmConfig:
    """Return the settings of a size."""
    return _SIZES[size]
