"""Registry of models, and building of a model from its name and options."""

from __future__ import annotations

import dataclasses
import types
import typing
from collections.abc import Callable, Mapping
from typing import Any, Literal, TypeVar

import numpy as np

from physion.dataclass_json import field_types, read_value, shown
from physion.errors import BadInputError, MissingExtraError, PhysionError, UnknownNameError
from physion.models.batch import Spec
from physion.models.from_file import is_file_name, load_from_file
from physion.models.interface import Model
from physion.models.raised import describe_raised
from physion.registry import Registry

C = TypeVar("C")

_EXTRAS = {
    **dict.fromkeys(("torch", "torchvision", "timm", "safetensors", "lightning_fabric"), "models"),
    "transformers": "video",
}
"""Extra that installs a library, by name of the library."""

ModelFactory = Callable[..., Model]
"""Function that builds a model from the fields of its config."""

models: Registry[ModelFactory] = Registry(
    "model",
    {
        "frozen-encoder": "physion.models.encoders.build:frozen_encoder",
        "pVGG-mlp": "physion.models.encoders.build:pvgg_mlp",
        "pVGG-lstm": "physion.models.encoders.build:pvgg_lstm",
        "pDeIT-mlp": "physion.models.encoders.build:pdeit_mlp",
        "pDeIT-lstm": "physion.models.encoders.build:pdeit_lstm",
        "pEffNetLite0-mlp": "physion.models.encoders.build:peffnet_mlp",
        "pEffNetLite0-lstm": "physion.models.encoders.build:peffnet_lstm",
        "cswm": "physion.models.cswm.build:cswm",
        "svg": "physion.models.svg.build:svg",
        "op3": "physion.models.op3.build:op3",
        "pDINO-mlp": "physion.models.encoders.build:pdino_mlp",
        "pDINO-lstm": "physion.models.encoders.build:pdino_lstm",
        "pDINOv2-mlp": "physion.models.encoders.build:pdinov2_mlp",
        "pDINOv2-lstm": "physion.models.encoders.build:pdinov2_lstm",
        "VideoMAE": "physion.models.encoders.video:videomae",
        "V-JEPA2": "physion.models.encoders.video:vjepa2",
        "gns": "physion.models.particles.build:gns",
        "gns-ransac": "physion.models.particles.build:gns_ransac",
        "dpi": "physion.models.particles.build:dpi",
        "rpin": "physion.models.rpin.build:rpin",
        "noisy-simulation": "physion.models.noisy_simulation:noisy_simulation",
        "noisy-simulation-outcomes": "physion.models.noisy_simulation:noise_of_outcomes",
        "noisy-simulation-people": "physion.models.noisy_simulation:noise_of_people",
        "outcome": "physion.models.anchors.outcome:outcome",
        "majority-of-people": "physion.models.anchors.majority_of_people:majority_of_people",
        "state-classifier": "physion.models.anchors.state_classifier:state_classifier",
        "already-touched": "physion.models.anchors.already_touched:already_touched",
        "chance": "physion.models.anchors.base_rate:base_rate",
        "constant-motion": "physion.models.anchors.constant_motion:constant_motion",
        "blob-centroids": "physion.models.anchors.blob_centroids:blob_centroids",
        "copy-last-frame": "physion.models.anchors.copy_last_frame:copy_last_frame",
    },
)
"""All models by name; other packages add theirs with the entry point group physion.models."""


def build_model(name: str, **options: Any) -> Model:
    """Build a model by its name.

    Parameters
    ----------
    name
        Name of a model (``physion ls models``), or ``FILE.py:Class`` for a class or function in a
        Python file. A class with ``transform`` and ``extract_features``, as the evaluator of
        Physion 1.5 takes it, becomes a model by `physion.models.extractor.ExtractorModel`.
    **options
        Fields of the model's config, which override its defaults; arguments of the class.

    Returns
    -------
    model
        Object with ``spec``, ``provenance``, ``digest`` and some of the methods of
        `physion.models.interface`.

    Raises
    ------
    UnknownNameError
        For an unknown model or option; the message names the closest ones.
    MissingExtraError
        If the libraries of a model of this package are not installed.
    BadInputError
        If a library of a plug-in is not installed, or the model cannot be built, or lacks what
        every model has.
    """
    if is_file_name(name):
        factory: ModelFactory = load_from_file(name)
    else:
        factory = _registered(name)
    try:
        model: Model = _adapted(factory(**options))
    except PhysionError:
        raise
    except ModuleNotFoundError as error:
        raise _missing(name, error) from error
    except Exception as error:
        raise describe_raised(error, name, "building it") from error
    _check_parts(model, name)
    return model


def _adapted(built: Any) -> Any:
    """Return a feature extractor as a model, and a model as it is."""
    methods = ("transform", "extract_features")
    if hasattr(built, "spec") or not all(callable(getattr(built, m, None)) for m in methods):
        return built
    from physion.models.extractor import ExtractorModel

    return ExtractorModel(built)


def _check_parts(model: Any, name: str) -> None:
    """Raise `BadInputError` if a model lacks what every model has."""
    advice = "see docs/own-model.md for what a model has"
    lacking = [part for part in ("spec", "provenance", "digest") if not hasattr(model, part)]
    if lacking:
        raise BadInputError(f"model {name!r} lacks {', '.join(lacking)}; {advice}")
    if not isinstance(model.spec, Spec):
        kind = type(model.spec).__name__
        raise BadInputError(f"model {name!r}: spec is a {kind}, expected a Spec; {advice}")
    for part in ("provenance", "digest"):
        if not callable(getattr(model, part)):
            raise BadInputError(f"model {name!r}: {part} must be a method; {advice}")


def _registered(name: str) -> ModelFactory:
    try:
        return models.get(name)
    except UnknownNameError as error:
        raise UnknownNameError(
            "model", name, models.names(), "for one of your own write FILE.py:Class"
        ) from error
    except ModuleNotFoundError as error:
        raise _missing(name, error) from error


def _missing(name: str, error: ModuleNotFoundError) -> Exception:
    """Return the error that names the extra, or the library, that a model needs."""
    library = (error.name or "").partition(".")[0]
    if library in _EXTRAS:
        return MissingExtraError(f"model {name!r}", _EXTRAS[library])
    return BadInputError(f"model {name!r} needs the library {error.name!r}, which is not installed")


def make_config(kind: type[C], model: str, options: Mapping[str, Any]) -> C:
    """Build a config of the dataclass ``kind`` from options, each checked against its type.

    Raises
    ------
    UnknownNameError
        For an unknown option.
    BadInputError
        For a value of another type than the field declares, or one that the config refuses.
    """
    known = field_types(kind)
    values = {}
    for option, value in options.items():
        if option not in known:
            raise UnknownNameError(f"option of model {model}", option, known)
        values[option] = _as_declared(known[option], value, f"option {option} of model {model}")
    config = kind(**values)
    # After the config's own checks, which say more about a wrong name.
    for option in values:
        chosen, names = getattr(config, option), typing.get_args(known[option])
        if typing.get_origin(known[option]) is Literal and chosen not in names:
            listed = ", ".join(map(str, names))
            raise BadInputError(
                f"option {option} of model {model} must be one of {listed}, not {shown(chosen)}"
            )
    return config


def _as_declared(kind: Any, value: Any, where: str) -> Any:
    """Return the value of an option as its field's type; raise `BadInputError` for another type.

    Values of fields that JSON cannot express, such as functions, stay as they are.
    """
    if not _is_plain(kind) or dataclasses.is_dataclass(value):
        return value
    # In Python, options may be tuples and numbers of numpy.
    if isinstance(value, tuple | list):
        return read_value(kind, [_without_numpy(item) for item in value], where)
    return read_value(kind, _without_numpy(value), where)


def _is_plain(kind: Any) -> bool:
    """Return whether JSON can express the values of a type."""
    origin = typing.get_origin(kind)
    if origin is types.UnionType:
        parts = typing.get_args(kind)
        return all(_is_plain(part) or typing.get_origin(part) is Literal for part in parts)
    return kind in (bool, int, float, str, types.NoneType) or origin is tuple


def _without_numpy(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
