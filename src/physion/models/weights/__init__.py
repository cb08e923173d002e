"""Weights of image encoders: where they come from, how they are read, which features they give.

- `source`: `EncoderWeights`, the origin of weights and what identifies them.
- `packages`: weights that are installed by pip.
- `state_dicts`: files of tensors, and whether they fit a network.
- `encoder`: frozen timm networks with these weights.
- `grid`: features that keep positions.
"""

from physion.models.weights.encoder import (
    check_encoder_name,
    create_classifier,
    create_encoder,
    feature_size,
    input_statistics,
)
from physion.models.weights.grid import GRID, POOLED, Pooling
from physion.models.weights.packages import WeightsPackage, weights_packages
from physion.models.weights.source import IMAGENET, PACKAGE, RANDOM, TIMM, EncoderWeights
from physion.models.weights.state_dicts import read_state_dict

__all__ = [
    "GRID",
    "IMAGENET",
    "PACKAGE",
    "POOLED",
    "RANDOM",
    "TIMM",
    "EncoderWeights",
    "Pooling",
    "WeightsPackage",
    "check_encoder_name",
    "create_classifier",
    "create_encoder",
    "feature_size",
    "input_statistics",
    "read_state_dict",
    "weights_packages",
]
