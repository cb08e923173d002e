"""Keys of the tasks of a plan: hashes of their inputs, found without building a model.

A key tells that a task was done by this code on these inputs, so that a second run need not import
torch. Another key is no proof of the contrary: the task is then asked for as usual, and its own
digest, which covers the weights, decides (`physion.training.train`, `physion.readout.evaluate`).
"""

from __future__ import annotations

import hashlib
import importlib.util
import json
from collections.abc import Iterable
from functools import cache
from importlib.metadata import EntryPoints, PackageNotFoundError, entry_points, version
from pathlib import Path
from typing import Any

import physion
from physion.models.build import is_file_name
from physion.readout.plans.selection import ModelChoice
from physion.trials.dataset import Dataset

_LIBRARIES = ("torch", "timm", "torchvision", "transformers", "lightning-fabric", "scikit-learn")
"""Libraries whose version can change a result."""
_WEIGHTS = "model.safetensors"
"""Name of a file with trained weights, `checkpoints.checkpoint.WEIGHTS`, here without torch."""
_COLUMNS = (
    "trial", "scenario", "split", "contact", "digest", "movie_sha256", "observed_movie_sha256",
    "recorded_contact", "observed_contact",
)  # fmt: skip


def key_of(*parts: Any) -> str:
    """Return the hexadecimal SHA-256 of JSON values; others count by their text."""
    return hashlib.sha256(json.dumps(parts, sort_keys=True, default=str).encode()).hexdigest()


@cache
def code_key() -> str:
    """Return the key of the source of this package and of the versions of its libraries."""
    folder = Path(physion.__file__).parent
    return key_of(_files(folder.rglob("*.py")), [(name, _version(name)) for name in _LIBRARIES])


def dataset_key(dataset: Dataset) -> str:
    """Return the key of the trials of a dataset, with their files and outcomes."""
    known = [name for name in _COLUMNS if name in dataset.index.columns]
    return key_of(dataset.index[known].to_csv(index=False))


def choice_key(choice: ModelChoice) -> str:
    """Return the key of a model: its name, its options, and the files that belong to it.

    These are the Python files beside a ``FILE.py:Class``, the package of a model that is not of
    this package, files that options name, and weights in folders that they name.
    """
    named = [Path(value) for value in choice.options.values() if isinstance(value, str)]
    named += [path / _WEIGHTS for path in named]
    sources: Iterable[Path] = ()
    if is_file_name(choice.name):
        sources = Path(choice.name.partition(":")[0]).resolve().parent.glob("*.py")
    else:
        for point in _plugins().select(name=choice.name):
            sources = _package_files(point.module.partition(".")[0])
    return key_of(
        choice.name,
        dict(choice.options),
        _files(sources),
        [_stamp(p) for p in named if _is_file(p)],
    )


@cache
def _plugins() -> EntryPoints:
    """Return the models of other packages; all installed packages are asked once."""
    return entry_points(group="physion.models")


def _files(paths: Iterable[Path]) -> list[tuple[str, str]]:
    return [
        (str(path), hashlib.sha256(path.read_bytes()).hexdigest())
        for path in sorted(paths)
        if path.is_file()
    ]


def _package_files(package: str) -> Iterable[Path]:
    found = importlib.util.find_spec(package)
    places = list(found.submodule_search_locations or ()) if found is not None else []
    if found is not None and not places and found.origin:
        return [Path(found.origin)]
    return [path for place in places for path in Path(place).rglob("*.py")]


def _version(name: str) -> str:
    try:
        return version(name)
    except PackageNotFoundError:
        return ""


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # such as a name that is too long
        return False


def _stamp(path: Path) -> tuple[str, int, int]:
    status = path.stat()
    return str(path.resolve()), status.st_size, status.st_mtime_ns
