"""Weights of models that this package trained: those that come with it, and those of a user."""

from __future__ import annotations

import json
from importlib.resources import as_file, files
from pathlib import Path
from typing import Any

import torch
from torch import nn

from physion.digests import file_sha256
from physion.errors import BadInputError
from physion.models.checkpoints.checkpoint import (
    WEIGHTS,
    DamagedFileError,
    check_same,
    describe_tensors,
    is_checkpoint,
    load_tensors,
    read_checkpoint,
)

RANDOM, SHIPPED = "random", "shipped"
"""Names of weights that are no path of a file: those to be trained, and those of the package."""
FOLDER = "shipped"
"""Name of the folder with the weights that are installed with the package."""
BUILT_AS = "built_as"
"""Metadata of weights: what the method of this name said of the model that was trained."""
DIGESTS = "sha256.json"
"""File with the SHA-256 of every shipped file by the name of the model."""


def shipped_digests() -> dict[str, str]:
    """Return the SHA-256 of the shipped weights by model."""
    text = (files(__package__) / FOLDER / DIGESTS).read_text()
    return {str(name): str(value) for name, value in json.loads(text).items()}


def load_named(model: Any, weights: str) -> None:
    """Load weights into a model by their name, and set its ``init`` and ``trained``.

    Parameters
    ----------
    model
        Torch ``Module`` with a ``name`` and its initial weights.
    weights
        `RANDOM`, which leaves the model as it is; `SHIPPED`; or the path of a file, or of the
        folder of a training.

    Raises
    ------
    BadInputError
        As `load_shipped` and `load_file`.
    """
    if weights == RANDOM:
        return
    if weights == SHIPPED:
        model.init = load_shipped(model, model.name)
    else:
        model.init = load_file(model, weights)
    model.trained = True


def load_shipped(model: nn.Module, name: str) -> str:
    """Load the weights that come with the package, and return their origin for the tables.

    Raises
    ------
    BadInputError
        If there are none for the model.
    DamagedFileError
        If the file was changed.
    """
    digests = shipped_digests()
    if name not in digests:
        known = f"only for {', '.join(digests)}" if digests else "nor for any other model"
        raise BadInputError(
            f"no weights are shipped for {name}, {known}; train it with physion train"
        )
    with as_file(files(__package__) / FOLDER / f"{name}.safetensors") as path:
        found = file_sha256(path) if path.is_file() else "no file"
        if found != digests[name]:
            raise DamagedFileError(
                f"the weights {path} that come with the package are damaged or changed; install "
                "the package again"
            )
        _load(path, model)
    return f"shipped:{digests[name][:12]}"


def trained_file(path: Path) -> Path | None:
    """Return the file with the weights of a training, given by its own path or its folder's.

    None if ``path`` is neither.
    """
    file = path / WEIGHTS if path.is_dir() else path
    return file if is_checkpoint(file) else None


def load_file(model: nn.Module, file: str) -> str:
    """Load a ``model.safetensors`` of ``physion train``, and return its origin for the tables.

    ``file`` may be the folder of the training, too.

    Raises `BadInputError` for a file that is missing, holds other weights, or weights of a model
    that was built otherwise (`BUILT_AS`).
    """
    path = Path(file)
    path = path / WEIGHTS if path.is_dir() else path
    if not path.is_file():
        raise BadInputError(
            f"there are no weights at {path}; give random, shipped, or the model.safetensors of "
            "a training"
        )
    _load(path, model)
    return f"local:{file_sha256(path)[:12]}"


def _load(path: Path, model: nn.Module) -> None:
    stored, metadata = read_checkpoint(path)
    # Large weights are shipped in half precision.
    halves = {name for name, value in stored.items() if value.dtype == torch.float16}
    tensors = {name: v.float() if name in halves else v for name, v in stored.items()}
    built_as = getattr(model, "built_as", None)
    if built_as is not None:
        advice = "build the model that the weights belong to, or give weights of this one"
        if differences := describe_tensors(tensors, model):
            advice = f"{differences}; {advice}"
        check_same(path, "model", metadata.get(BUILT_AS, {}), built_as(), advice)
    load_tensors(path, tensors, model)
