"""Weights of models in safetensors files, with metadata as JSON in their headers.

Only safetensors and JSON are read, so that no code in a file can be executed. Weights that are kept
have a digest file next to them (`core.files`); checkpoints of a running training have none.
"""

from __future__ import annotations

import json
import platform
from collections.abc import Callable, Mapping
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load, save
from torch import Tensor, nn
from torch.optim import Optimizer

from physion.core.errors import BadInputError
from physion.core.files import (
    SUFFIX,
    check_digest,
    file_sha256,
    has_digest,
    write_atomic,
    write_with_digest,
)
from physion.core.settings import flatten
from physion.core.version import __version__
from physion.models.interface import RANDOM, SHIPPED, ask

_METADATA = "physion"
_VERSION = 1
"""To be increased with every change of the files."""
_MODEL, _OPTIMIZER = "model/", "optimizer/"
WEIGHTS = "model.safetensors"
"""Name of the file with the weights of a finished training."""
_NAMED = 3
"""Largest number of differences that a message names."""


class DamagedFileError(BadInputError):
    """Error for a checkpoint that was cut or changed, or that is none."""


def versions() -> dict[str, str]:
    """Return the versions of this package, torch and Python."""
    return {
        "physion": __version__,
        "torch": str(torch.__version__),
        "python": platform.python_version(),
    }


def write_checkpoint(
    path: Path, tensors: Mapping[str, Tensor], metadata: Mapping[str, Any], *, kept: bool = False
) -> None:
    """Write tensors and metadata, JSON values, to a file that is replaced atomically.

    ``kept``: whether a digest file is written next to it, for weights that people keep or exchange.
    """
    copies = {
        name: value.detach().to("cpu", copy=True).contiguous() for name, value in tensors.items()
    }
    content = {**metadata, "version": _VERSION}
    path.parent.mkdir(parents=True, exist_ok=True)
    # One key only: safetensors stores several in a random order.
    data = save(copies, {_METADATA: json.dumps(content, sort_keys=True)})
    (write_with_digest if kept else write_atomic)(path, data)


def read_checkpoint(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Return tensors and metadata of a file.

    Raises
    ------
    DamagedFileError
        If it cannot be read, is not what its digest file says, or `write_checkpoint` did not write
        it.
    BadInputError
        If another version of this package wrote it.
    """
    try:
        if has_digest(path):
            check_digest(path, path.read_bytes(), "get it again")
        with safe_open(path, framework="pt") as file:
            header = file.metadata() or {}
            names = list(file.keys())
            tensors = {name: file.get_tensor(name) for name in names} if header else {}
    except BadInputError as error:
        raise DamagedFileError(str(error)) from error
    except (SafetensorError, OSError, ValueError) as error:
        raise DamagedFileError(f"checkpoint {path} cannot be read ({error})") from error
    if _METADATA not in header:
        raise DamagedFileError(f"{path} is a safetensors file, but not a checkpoint of physion")
    try:
        metadata = json.loads(header[_METADATA])
        known = metadata["version"] == _VERSION
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise DamagedFileError(f"checkpoint {path} cannot be read: damaged metadata") from error
    if not known:
        raise BadInputError(
            f"checkpoint {path} has version {metadata['version']}, not {_VERSION}; read it with "
            f"physion {metadata.get('versions', {}).get('physion', '')}, or move it elsewhere"
        )
    return tensors, metadata


def is_checkpoint(path: Path) -> bool:
    """Return whether a file is one that `write_checkpoint` wrote, whole or not."""
    try:
        with safe_open(path, framework="pt") as file:
            return _METADATA in (file.metadata() or {})
    except (SafetensorError, OSError, ValueError):
        return False


def tensors_of(model: nn.Module, optimizer: Optimizer | None = None) -> dict[str, Tensor]:
    """Return the tensors of a model, and of an optimiser, by the names in a checkpoint."""
    tensors = {_MODEL + name: value for name, value in model.state_dict().items()}
    if optimizer is not None:
        for index, values in optimizer.state_dict()["state"].items():
            tensors |= {f"{_OPTIMIZER}{index}/{key}": value for key, value in values.items()}
    return tensors


def load_tensors(
    path: Path,
    tensors: Mapping[str, Tensor],
    model: nn.Module,
    optimizer: Optimizer | None = None,
) -> None:
    """Load tensors of the file ``path`` into a model, and into an optimiser.

    Raises `BadInputError`, and changes nothing, for tensors of another network; the message names
    the tensors that differ.
    """
    weights = _with_prefix(tensors, _MODEL)
    if differences := compare_tensors(weights, model.state_dict()):
        raise BadInputError(
            f"checkpoint {path} holds the weights of another network: {differences}"
        )
    model.load_state_dict(weights)
    if optimizer is not None:
        state: dict[int, dict[str, Tensor]] = {}
        for name, value in _with_prefix(tensors, _OPTIMIZER).items():
            index, _, key = name.partition("/")
            state.setdefault(int(index), {})[key] = value
        groups = optimizer.state_dict()["param_groups"]
        optimizer.load_state_dict({"state": state, "param_groups": groups})


def load_weights(path: Path, model: nn.Module) -> None:
    """Load the weights of a trained model from its file into a model that was built alike.

    Raises `BadInputError` for a damaged or foreign file, or the weights of another network.
    """
    tensors, _ = read_checkpoint(path)
    load_tensors(path, tensors, model)


def check_same(
    path: Path,
    what: str,
    stored: Mapping[str, Any],
    current: Mapping[str, Any],
    advice: str = "delete it to start again",
) -> None:
    """Raise `BadInputError` that names the values of ``what`` that differ, and what to do."""
    old, new = flatten(stored), flatten(current)
    differences = [
        f"{key} was {_shown(old, key)} and is {_shown(new, key)}"
        for key in sorted({*old, *new})
        if old.get(key) != new.get(key)
    ]
    if differences:
        raise BadInputError(
            f"checkpoint {path} belongs to another {what}: {_listed(differences)}; {advice}"
        )


def _with_prefix(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def compare_tensors(
    stored: Mapping[str, Tensor], model: Mapping[str, Tensor], *, types: bool = True
) -> str:
    """Return which tensors are missing, unknown, or of another shape or type, as text; "" if none.

    Without ``types``, only shapes are compared.
    """

    def described(tensor: Tensor) -> str:
        kind = f"{str(tensor.dtype).removeprefix('torch.')} " if types else ""
        return f"{kind}{tuple(tensor.shape)}"

    differences = [f"{name} is missing" for name in model if name not in stored]
    differences += [f"{name} is unknown" for name in stored if name not in model]
    for name in model:
        if name in stored and (old := described(stored[name])) != (new := described(model[name])):
            differences.append(f"{name} is {old}, and {new} in the model")
    return _listed(differences)


def _listed(differences: list[str]) -> str:
    more = len(differences) - _NAMED
    return "; ".join(differences[:_NAMED]) + (f"; and {more} more" if more > 0 else "")


def _shown(values: Mapping[str, Any], key: str) -> str:
    if key not in values:
        return "not there"
    text = str(values[key])
    return text if len(text) <= 20 else text[:16] + "..."


# Weights of models that this package trained: shipped weights, and weights of a user.

FOLDER = "physion.data.weights"
"""Name of the folder with the weights that are installed with the package."""
Network = TypeVar("Network", bound=nn.Module)
BUILT_AS = "built_as"
"""Metadata key of weights: the return value of the model's ``built_as()``."""


def shipped_digests() -> dict[str, str]:
    """Return the SHA-256 of the shipped weights by model, from their digest files."""
    ending = f".safetensors{SUFFIX}"
    found = [file for file in files(FOLDER).iterdir() if file.name.endswith(ending)]
    texts = {file.name.removesuffix(ending): file.read_text() for file in found}
    return {name: texts[name].partition(" ")[0] for name in sorted(texts)}


def load_packaged(network: Callable[[], Network], package: str, name: str) -> Network:
    """Return a network that is a part of models, with its weights from a file of the package.

    Parameters
    ----------
    network
        Makes it, here without random weights.
    package, name
        Where the file with its ``state_dict`` is. Half precision becomes single precision.

    Raises
    ------
    BadInputError
        If the file was changed.
    """
    with as_file(files(package)) as folder:
        content = (folder / name).read_bytes()
        check_digest(folder / name, content, "install the package again")
    with torch.device("meta"):
        made = network()
    weights = {key: value.float() for key, value in load(content).items()}
    made.load_state_dict(weights, assign=True)
    made.eval()
    return made


def packaged_sha256(package: str, name: str) -> str:
    """Return the SHA-256 of a file of the package."""
    with as_file(files(package)) as folder:
        return file_sha256(folder / name)


def load_named(model: Any, weights: str) -> None:
    """Load weights into a model by their name, and set its ``init`` and ``trained``.

    Parameters
    ----------
    model
        Torch ``Module`` with a ``name`` and its initial weights.
    weights
        `RANDOM`, which leaves the model as it is; `SHIPPED`; or the path of a ``model.safetensors``
        of ``physion train``, or of its folder.

    Raises
    ------
    BadInputError
        If there are no such weights, or if they belong to another model, or to one that was built
        otherwise (`BUILT_AS`).
    DamagedFileError
        If the file was changed.
    """
    if weights == RANDOM:
        return
    if weights == SHIPPED:
        digests = shipped_digests()
        if model.name not in digests:
            raise BadInputError(
                f"no weights are shipped for {model.name}, only for {', '.join(digests)}; train it "
                "with physion train"
            )
        with as_file(files(FOLDER) / f"{model.name}.safetensors") as path:
            try:
                _load(path, model)
            except DamagedFileError as error:
                raise DamagedFileError(f"{error}; install the package again") from error
        model.init = f"shipped:{digests[model.name][:12]}"
    else:
        path = Path(weights)
        path = path / WEIGHTS if path.is_dir() else path
        if not path.is_file():
            raise BadInputError(
                f"there are no weights at {path}; give random, shipped, or the model.safetensors "
                "of a training"
            )
        _load(path, model)
        model.init = f"local:{file_sha256(path)[:12]}"
    model.trained = True


def trained_file(path: Path) -> Path | None:
    """Return the file with the weights of a training, given by its own path or its folder's.

    None if ``path`` is neither.
    """
    file = path / WEIGHTS if path.is_dir() else path
    return file if is_checkpoint(file) else None


def _load(path: Path, model: nn.Module) -> None:
    stored, metadata = read_checkpoint(path)
    # Large weights are shipped in half precision.
    halves = {name for name, value in stored.items() if value.dtype == torch.float16}
    tensors = {name: v.float() if name in halves else v for name, v in stored.items()}
    if built_as := ask(model, BUILT_AS)():
        advice = "build the model that the weights belong to, or give weights of this one"
        weights = _with_prefix(tensors, _MODEL)
        if differences := compare_tensors(weights, model.state_dict()):
            advice = f"{differences}; {advice}"
        check_same(path, "model", metadata.get(BUILT_AS, {}), built_as, advice)
    load_tensors(path, tensors, model)
