"""Registry of models, and building of a model from its name and options."""

from __future__ import annotations

import dataclasses
import importlib.util
import sys
import traceback
import types
import typing
from collections.abc import Callable, Mapping
from importlib.abc import ExecutionLoader
from pathlib import Path
from typing import Any, Literal, TypeVar

from physion.clips.batch import Spec
from physion.core.errors import BadInputError, MissingExtraError, PhysionError, UnknownNameError
from physion.core.registry import Registry
from physion.core.seeds import stable_hash
from physion.core.settings import field_types, read_settings, shown
from physion.models.interface import Model

# Models in a user's Python file, named as ``FILE.py:Class``, without an installation.

_loaded: dict[str, tuple[Path, str]] = {}
"""Path and text of the files that were loaded, by name of the module."""


class FileLoader(ExecutionLoader):
    """Loader of a module from a text, which was read from ``path`` and may differ from it now."""

    def __init__(self, path: Path, text: str) -> None:
        self.path, self.text = path, text

    def get_filename(self, fullname: str) -> str:
        """Return the path, for tracebacks and ``__file__``."""
        return str(self.path)

    def get_source(self, fullname: str) -> str:
        """Return the text."""
        return self.text


class LoadedFiles:
    """The files that were loaded; whatever process unpickles this object loads them, too.

    Pickled before a model, it makes the classes of the model known where it is unpickled.
    """

    def __reduce__(self) -> tuple[Any, ...]:
        return _load_again, (dict(_loaded),)


def _load_again(files: dict[str, tuple[Path, str]]) -> LoadedFiles:
    for known, (path, text) in files.items():
        if known not in sys.modules:
            _run(known, path, text)
    return LoadedFiles()


def is_file_name(name: str) -> bool:
    """Return whether a model's name is of the form ``FILE.py:Class``."""
    return Path(name.partition(":")[0]).suffix == ".py"


def load_from_file(name: str) -> Any:
    """Import a Python file and return the class or function after the colon.

    The file is run as it stands, as any program that the user starts. It may import modules beside
    it. Raises `BadInputError` if it is missing or fails, with the line that failed, and
    `UnknownNameError` if it does not define the name.
    """
    text, _, attribute = name.partition(":")
    path = Path(text).resolve()
    if not path.is_file():
        raise BadInputError(f"model {name!r}: there is no file {text}")
    if not attribute:
        raise BadInputError(f"model {name!r} names a file alone; write {text}:NameOfTheClass")
    module = _import(path, name)
    if not hasattr(module, attribute):
        public = [key for key in vars(module) if not key.startswith("_")]
        raise UnknownNameError(f"name in {text}", attribute, public)
    return getattr(module, attribute)


def _import(path: Path, name: str) -> Any:
    # A name of its own, so that a user's file called torch.py or physion.py hides nothing. It
    # depends on the text: a file that was edited, in a session that goes on, is another module.
    try:
        text = importlib.util.decode_source(path.read_bytes())
    except (OSError, SyntaxError, UnicodeDecodeError) as error:
        raise BadInputError(f"model {name!r}: {path} cannot be read: {error}") from error
    known = f"physion_model_{path.stem}_{stable_hash(str(path), text) % 2**32:08x}"
    if known in sys.modules:
        return sys.modules[known]
    try:
        return _run(known, path, text)
    except ModuleNotFoundError as error:
        raise BadInputError(
            f"model {name!r} needs the library {error.name!r}, which is not installed"
        ) from error
    except Exception as error:
        where = _line_in(error, path)
        what = error.msg if isinstance(error, SyntaxError) else error
        raise BadInputError(
            f"model {name!r}: {path.name}{where} raised {type(error).__name__}: {what}"
        ) from error


def _run(known: str, path: Path, text: str) -> Any:
    """Run the text of a file as the module ``known``; leave no module behind if it fails."""
    loader = FileLoader(path, text)
    spec = importlib.util.spec_from_loader(known, loader)
    assert spec is not None, "there is a loader"
    module = importlib.util.module_from_spec(spec)
    sys.modules[known] = module
    sys.path.insert(0, str(path.parent))
    try:
        loader.exec_module(module)
    except BaseException:
        del sys.modules[known]
        raise
    finally:
        sys.path.remove(str(path.parent))
    _loaded[known] = path, text
    return module


def _line_in(error: BaseException, path: Path) -> str:
    """Return ``", line N"`` of the last line of ``path`` in the traceback of an error."""
    if isinstance(error, SyntaxError):
        return f", line {error.lineno}"
    line, trace = None, error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == str(path):
            line = trace.tb_lineno
        trace = trace.tb_next
    return "" if line is None else f", line {line}"


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
        "frozen-encoder": "physion.models.encoders.encoder:frozen_encoder",
        "pVGG-mlp": "physion.models.encoders.encoder:pvgg_mlp",
        "pVGG-lstm": "physion.models.encoders.encoder:pvgg_lstm",
        "pDeIT-mlp": "physion.models.encoders.encoder:pdeit_mlp",
        "pDeIT-lstm": "physion.models.encoders.encoder:pdeit_lstm",
        "pEffNetLite0-mlp": "physion.models.encoders.encoder:peffnet_mlp",
        "pEffNetLite0-lstm": "physion.models.encoders.encoder:peffnet_lstm",
        "cswm": "physion.models.cswm:cswm",
        "svg": "physion.models.svg:svg",
        "op3": "physion.models.op3:op3",
        "pDINO-mlp": "physion.models.encoders.encoder:pdino_mlp",
        "pDINO-lstm": "physion.models.encoders.encoder:pdino_lstm",
        "pDINOv2-mlp": "physion.models.encoders.encoder:pdinov2_mlp",
        "pDINOv2-lstm": "physion.models.encoders.encoder:pdinov2_lstm",
        "VideoMAE": "physion.models.encoders.video:videomae",
        "V-JEPA2": "physion.models.encoders.video:vjepa2",
        "gns": "physion.models.particles.simulator:gns",
        "gns-ransac": "physion.models.particles.simulator:gns_ransac",
        "dpi": "physion.models.particles.simulator:dpi",
        "rpin": "physion.models.rpin:rpin",
        "noisy-simulation": "physion.models.noisy_simulation:noisy_simulation",
        "noisy-simulation-outcomes": "physion.models.noisy_simulation:noise_of_outcomes",
        "noisy-simulation-people": "physion.models.noisy_simulation:noise_of_people",
        "outcome": "physion.models.baselines.answers:outcome",
        "majority-of-people": "physion.models.baselines.answers:majority_of_people",
        "state-classifier": "physion.models.baselines.motion:state_classifier",
        "already-touched": "physion.models.baselines.motion:already_touched",
        "chance": "physion.models.baselines.answers:base_rate",
        "constant-motion": "physion.models.baselines.motion:constant_motion",
        "blob-centroids": "physion.models.baselines.pixels:blob_centroids",
        "copy-last-frame": "physion.models.baselines.pixels:copy_last_frame",
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
    return read_settings(kind, value, where)


def _is_plain(kind: Any) -> bool:
    """Return whether JSON can express the values of a type."""
    origin = typing.get_origin(kind)
    if origin is types.UnionType:
        parts = typing.get_args(kind)
        return all(_is_plain(part) or typing.get_origin(part) is Literal for part in parts)
    return kind in (bool, int, float, str, types.NoneType) or origin is tuple
