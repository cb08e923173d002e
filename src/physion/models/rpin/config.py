"""Settings of RPIN, and its sizes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from physion.models.settings import TrainingSettings
from physion.models.vision.model import Size


@dataclass(frozen=True, slots=True)
class RpinConfig:
    """All settings of RPIN.

    - ``image_size``: pixels per side. ``objects``: rows of boxes K.
    - ``history``: observed frames h from which the next one is predicted. ``rollout``: frames that
      are predicted in training.
    - ``width``: channels of the feature maps and states; the first convolution has a quarter of
      them. ``groups``: of group normalisation. ``depth``: scales of the hourglass.
    - ``pool``: cells per side of a region. ``sampling``: points per side of a cell, and
      ``aligned``: whether pixel centres, not corners, are at whole numbers (`RoIAlign`).
    - ``margin``: part of width and height by which a box is enlarged before its region is cut out.
    - ``outputs``: what is decoded: ``boxes``, the changes of centre and size; or ``published``, the
      change of the centre and, on its own, the centre, in pixels, while sizes stay.
    - ``offset_weight``, ``position_weight``: of the published loss.
    - ``training``: optimiser and schedule.
    """

    image_size: int = 64
    objects: int = 8
    history: int = 4
    rollout: int = 8
    width: int = 32
    groups: int = 4
    depth: int = 2
    pool: int = 3
    sampling: int = 2
    aligned: bool = True
    margin: float = 0.1
    outputs: Literal["boxes", "published"] = "boxes"
    offset_weight: float = 100.0
    position_weight: float = 1.0
    training: TrainingSettings = field(default_factory=TrainingSettings)


_SMALL = RpinConfig(
    training=TrainingSettings(
        steps=1800,
        batch=16,
        learning_rate=1e-3,
        schedule="cosine",
        warmup=30,
        clip=1.0,
        validate_every=100,
        log_every=20,
        checkpoint_every=100,
    )
)
_PAPER = RpinConfig(
    image_size=256,
    objects=10,
    rollout=11,
    width=256,
    groups=32,
    depth=4,
    training=replace(_SMALL.training, steps=100_000, learning_rate=2e-4, warmup=2000),
)
_RELEASED = replace(
    _PAPER,
    history=5,
    sampling=1,
    aligned=False,
    outputs="published",
    # The published code makes a new Adam at every step, which equals betas of 0.
    training=replace(
        _PAPER.training,
        steps=1_000_000,
        learning_rate=2e-6,
        weight_decay=1e-6,
        betas=(0.0, 0.0),
        schedule="constant",
        warmup=0,
        clip=0.0,
    ),
)
_SIZES: dict[Size, RpinConfig] = {"small": _SMALL, "paper": _PAPER, "released": _RELEASED}


def rpin_config(size: Size) -> RpinConfig:
    """Return the settings of a size."""
    return _SIZES[size]
