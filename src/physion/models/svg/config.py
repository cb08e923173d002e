"""Settings of SVG, and its sizes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from physion.errors import BadInputError
from physion.models.settings import TrainingSettings
from physion.models.vision.model import VisionOptions

Backbone = Literal["dcgan", "vgg"]
LARGEST_IMAGE = 256


@dataclass(frozen=True, slots=True)
class SvgOptions(VisionOptions):
    """What a user chooses of SVG; also see `VisionOptions`.

    - ``backbone``: ``dcgan`` or ``vgg``; by default (empty) that of the size.
    - ``image_size``: pixels per side, a power of 2 from 16 on; by default (0) that of the size, 64.
    - ``samples``: futures of a trial, whose features the readout joins.
    """

    backbone: Backbone | Literal[""] = ""
    image_size: int = 0
    samples: int = 1

    def __post_init__(self) -> None:
        # Not super(): a dataclass with slots is made anew, which super() does not know.
        VisionOptions.__post_init__(self)
        if self.backbone not in ("", "dcgan", "vgg"):
            raise BadInputError(f"SVG has the backbones dcgan and vgg, not {self.backbone!r}")
        if isinstance(self.samples, bool) or not isinstance(self.samples, int) or self.samples < 1:
            raise BadInputError(f"samples must be a whole number from 1 on, not {self.samples!r}")


@dataclass(frozen=True, slots=True)
class SvgConfig:
    """All settings of SVG.

    - ``backbone``, ``image_size``, ``width``: channels of the first stage of the encoder; they
      double to at most 8 times as many.
    - ``norm``: ``batch`` as published, or ``group``, which does not depend on the other clips.
    - ``code``: g, size of the features. ``latent``: size of z. ``hidden``: units of the LSTMs;
      ``layers``: of the LSTM that predicts, the others have one.
    - ``past``, ``imagined``: frames of a training clip that are observed, and that follow.
    - ``beta``: weight of the divergence.
    - ``motion``: additional weight of moving pixels in the loss; published 0. Few pixels move, and
      a short training would learn the scenery alone.
    - ``skip``: whose frame's inner activations the decoder sees: ``last`` observed one, or the one
      ``before`` it, as in the published code.
    - ``stride``, ``context``, ``future``: see `physion.models.batch.Spec`.
    - ``training``: optimiser and schedule.
    """

    backbone: Backbone = "dcgan"
    image_size: int = 64
    width: int = 16
    norm: Literal["batch", "group"] = "group"
    code: int = 64
    latent: int = 10
    hidden: int = 128
    layers: int = 2
    past: int = 7
    imagined: int = 9
    beta: float = 1e-4
    motion: float = 20.0
    skip: Literal["last", "before"] = "last"
    stride: int = 6
    context: int = 7
    future: int = 18
    training: TrainingSettings = field(default_factory=TrainingSettings)

    def __post_init__(self) -> None:
        size = self.image_size
        if size < 16 or size > LARGEST_IMAGE or size & (size - 1):
            raise BadInputError(
                f"SVG: image_size must be 16, 32, 64, 128 or {LARGEST_IMAGE}, not {size}"
            )
        if min(self.past, self.context) < 2 or self.imagined < 1:
            raise BadInputError(
                f"SVG: past {self.past} and context {self.context} must be at least 2, and "
                f"imagined {self.imagined} at least 1"
            )


_SMALL = TrainingSettings(
    steps=3000,
    batch=16,
    learning_rate=1e-3,
    schedule="cosine",
    warmup=100,
    clip=1.0,
    validate_every=500,
    log_every=50,
    checkpoint_every=500,
)
# Published for Physion, before the paper: 300 epochs of 600 steps.
_PAPER = replace(
    _SMALL, steps=180_000, batch=40, learning_rate=2e-3, schedule="constant", warmup=0, clip=0.0,
    betas=(0.9, 0.999), validate_every=600,
)  # fmt: skip


def svg_config(options: SvgOptions) -> SvgConfig:
    """Return the settings of a size."""
    config = SvgConfig(training=_SMALL)
    if options.size != "small":
        config = SvgConfig(
            "vgg",
            width=64,
            norm="batch",
            code=128,
            latent=64,
            hidden=256,
            past=4,
            imagined=6,
            motion=0.0,
            skip="before" if options.size == "released" else "last",
            training=_PAPER,
        )
    return replace(
        config,
        backbone=options.backbone or config.backbone,
        image_size=options.image_size or config.image_size,
    )
