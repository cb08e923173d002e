"""Registry of models, and building of a model from its name and options."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, TypeVar

from physion.errors import MissingExtraError, UnknownNameError
from physion.models.interface import Model
from physion.registry import Registry

C = TypeVar("C")

_EXTRA_LIBRARIES = ("torch", "torchvision", "timm", "safetensors", "lightning_fabric")

ModelFactory = Callable[..., Model]
"""Function that builds a model from the fields of its config."""

models: Registry[ModelFactory] = Registry(
    "model",
    {
        "frozen-encoder": "physion.models.frozen_encoder:frozen_encoder",
        "pVGG-mlp": "physion.models.frozen_encoder:pvgg_mlp",
        "pVGG-lstm": "physion.models.frozen_encoder:pvgg_lstm",
        "pDeIT-mlp": "physion.models.frozen_encoder:pdeit_mlp",
        "pDeIT-lstm": "physion.models.frozen_encoder:pdeit_lstm",
        "noisy-simulation": "physion.models.noisy_simulation:noisy_simulation",
    },
)
"""All models by name; other packages add theirs with the entry point group physion.models."""


def build_model(name: str, **options: Any) -> Model:
    """Build the model called ``name``; ``options`` override the defaults of its config.

    Raises `UnknownNameError` with the closest names for an unknown model or option, and
    `MissingExtraError` for a model whose libraries are not installed.
    """
    try:
        factory = models.get(name)
    except ModuleNotFoundError as error:
        if (error.name or "").partition(".")[0] in _EXTRA_LIBRARIES:
            raise MissingExtraError(f"model {name!r}", "models") from error
        raise
    return factory(**options)


def make_config(kind: type[C], model: str, options: Mapping[str, Any]) -> C:
    """Build a config of the dataclass ``kind``; raise `UnknownNameError` for an unknown option."""
    known = [field.name for field in dataclasses.fields(kind)]  # type: ignore[arg-type]
    for option in options:
        if option not in known:
            raise UnknownNameError(f"option of model {model}", option, known)
    return kind(**options)
