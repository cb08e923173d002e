"""Records of finished tasks: a sealed JSON file each, valid while the files they name stay."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from physion.core.errors import BadInputError
from physion.core.files import read_sealed, write_sealed

FOLDER = "plan"
"""Folder of the records in an output folder."""


class Records:
    """Records of one kind in an output folder.

    A record names files of its task with their size and time of change. If one of them is missing
    or differs, there is no record: the task is done again, or found done by its own digest.

    Parameters
    ----------
    folder
        Output folder.
    kind
        Name of the tasks: ``trainings``, ``evaluations``, ``models``.
    """

    def __init__(self, folder: Path, kind: str) -> None:
        self._root, self._folder = folder, folder / FOLDER / kind

    def read(self, key: str) -> dict[str, Any] | None:
        """Return the values of the record of a task, if it is valid."""
        return self._read(self._path(key))

    def write(self, key: str, values: Mapping[str, Any], files: Iterable[Path] = ()) -> None:
        """Write down that a task is done; numbers that are not finite become null."""
        stamps = {self._name(path): _stamp(path) for path in files}
        content = {"values": {name: _finite(v) for name, v in values.items()}, "files": stamps}
        self._folder.mkdir(parents=True, exist_ok=True)
        write_sealed(self._path(key), content)

    def all(self) -> list[dict[str, Any]]:
        """Return the values of all valid records, in the order of their keys."""
        paths = sorted(self._folder.glob("*.json")) if self._folder.is_dir() else []
        return [values for path in paths if (values := self._read(path)) is not None]

    def _path(self, key: str) -> Path:
        return self._folder / f"{key[:32]}.json"

    def _name(self, path: Path) -> str:
        return path.relative_to(self._root).as_posix()

    def _read(self, path: Path) -> dict[str, Any] | None:
        try:
            content = read_sealed(path)
            if any(_stamp(self._root / name) != stamp for name, stamp in content["files"].items()):
                return None
            values = content["values"]
        except (BadInputError, OSError, KeyError, TypeError, AttributeError):
            return None
        return values if isinstance(values, dict) else None


def _stamp(path: Path) -> list[int]:
    status = path.stat()
    return [status.st_size, status.st_mtime_ns]


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value
