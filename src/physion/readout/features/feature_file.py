"""Files of features: raw arrays that can be memory-mapped, and a checksum over every byte.

A file is a safetensors file: the length of the header (8 bytes, little-endian), a JSON header, and
the arrays one after the other. The header's ``__metadata__`` holds what the features depend on and
``sha256``, the SHA-256 of the header without this entry and of all arrays. A reader writes the
header anew from what it says and compares the bytes, so that no bit of a file can change unnoticed.
"""

from __future__ import annotations

import hashlib
import json
import math
import mmap
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from physion.atomic import write_atomic
from physion.errors import BadInputError

_DTYPES: dict[str, np.dtype[Any]] = {
    "F32": np.dtype("<f4"),
    "F64": np.dtype("<f8"),
    "BOOL": np.dtype("?"),
}
_NAMES = {dtype: name for name, dtype in _DTYPES.items()}
_ALIGNMENT = 64
"""The arrays start at a multiple of this many bytes."""
_LENGTH = 8
"""Bytes of the length of the header."""
_CHECKSUM = "sha256"


class _DamagedError(Exception):
    """Error for bytes that are not those of a file of features."""


class FeatureArrays(Protocol):
    """Arrays of one trial, by name, in a file or in memory."""

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Shapes of the arrays."""
        ...

    def read(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return values ``start`` to ``stop`` of the flattened array ``name``."""
        ...


@dataclass(frozen=True, eq=False)
class ArraysInMemory:
    """Arrays of one trial that are not stored."""

    arrays: Mapping[str, NDArray[Any]]

    @property
    def shapes(self) -> Mapping[str, tuple[int, ...]]:
        """Shapes of the arrays."""
        return {name: value.shape for name, value in self.arrays.items()}

    def read(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return values ``start`` to ``stop`` of the flattened array ``name``."""
        return self.arrays[name].reshape(-1)[start:stop]


@dataclass(frozen=True)
class FeatureFile:
    """File of features whose checksum was verified when it was opened.

    - ``shapes``, ``offsets``: of the arrays, by name; offsets in bytes from the start.
    - ``stamp``: inode, size and time of change. A file that no longer has it is not read.
    """

    path: Path
    dtypes: Mapping[str, np.dtype[Any]]
    shapes: Mapping[str, tuple[int, ...]]
    offsets: Mapping[str, int]
    stamp: tuple[int, int, int]

    def read(self, name: str, start: int = 0, stop: int | None = None) -> NDArray[Any]:
        """Return values ``start`` to ``stop`` of the flattened array ``name``.

        The file is mapped for the time of the call only: Python keeps a file descriptor for every
        map, and thousands of trials are read at a time.

        Raises
        ------
        BadInputError
            If the file was deleted or changed since it was opened.
        """
        dtype, size = self.dtypes[name], math.prod(self.shapes[name])
        stop = size if stop is None else min(stop, size)
        if stop <= start:
            return np.zeros(0, dtype)
        try:
            with _mapped(self.path) as (memory, stamp):
                if stamp == self.stamp:
                    offset = self.offsets[name] + start * dtype.itemsize
                    return np.frombuffer(memory, dtype, stop - start, offset).copy()
        except OSError as error:
            raise BadInputError(
                f"features {self.path} cannot be read ({error.strerror}); run again"
            ) from None
        raise BadInputError(f"features {self.path} changed while they were in use; run again")


def write_features(
    path: Path, identity: Mapping[str, str], arrays: Mapping[str, NDArray[Any]]
) -> None:
    """Write a file of features such that no reader sees a part of it.

    Parameters
    ----------
    path
        File to write or replace; its folder is made.
    identity
        What the features depend on: digest of the model, key of the clip, ...
    arrays
        float32, float64 or bool.

    Raises
    ------
    BadInputError
        If the file cannot be written, for example because the disk is full.
    """
    values = [
        np.ascontiguousarray(value, _DTYPES[_NAMES[value.dtype]]) for value in arrays.values()
    ]
    shapes = {
        name: (_NAMES[value.dtype], value.shape) for name, value in zip(arrays, values, strict=True)
    }
    data = b"".join(value.tobytes() for value in values)
    checksum = _checksum(_header(identity, shapes, None), data)
    head = _header(identity, shapes, checksum)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, len(head).to_bytes(_LENGTH, "little") + head + data)
    except OSError as error:
        raise BadInputError(
            f"features cannot be stored in {path.parent} ({error.strerror}); free space there, or "
            "choose another folder"
        ) from error


def open_features(path: Path, identity: Mapping[str, str]) -> FeatureFile | None:
    """Return the file at ``path`` after its checksum was verified.

    Returns None if there is no such file, if a byte of it is damaged, or if its features depend on
    something else than ``identity``: they must be computed again.
    """
    try:
        with _mapped(path) as (memory, stamp):
            return _verify(path, memory, stamp, identity)
    except (OSError, _DamagedError):
        return None


def _verify(
    path: Path, memory: mmap.mmap, stamp: tuple[int, int, int], identity: Mapping[str, str]
) -> FeatureFile:
    length = int.from_bytes(memory[:_LENGTH], "little")
    if length > len(memory) - _LENGTH:
        raise _DamagedError("header")
    head, start = memory[_LENGTH : _LENGTH + length], _LENGTH + length
    stored, shapes = _parse(head)
    checksum = stored.pop(_CHECKSUM, None)
    if stored != dict(identity) or head != _header(stored, shapes, checksum):
        raise _DamagedError("header")
    offsets = {}
    for name, (dtype, shape) in shapes.items():
        offsets[name] = start
        start += math.prod(shape) * _DTYPES[dtype].itemsize
    if start != len(memory):
        raise _DamagedError("size")
    with memoryview(memory) as view, view[_LENGTH + length :] as data:
        if _checksum(_header(stored, shapes, None), data) != checksum:
            raise _DamagedError("checksum")
    dtypes = {name: _DTYPES[dtype] for name, (dtype, _) in shapes.items()}
    return FeatureFile(path, dtypes, {n: s for n, (_, s) in shapes.items()}, offsets, stamp)


def _parse(head: bytes) -> tuple[dict[str, Any], dict[str, tuple[str, tuple[int, ...]]]]:
    """Return the metadata, and the data type and shape of every array."""
    try:
        content = json.loads(head)
        metadata = content.pop("__metadata__")
        shapes = {name: (item["dtype"], tuple(item["shape"])) for name, item in content.items()}
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
        raise _DamagedError("header") from None
    if not isinstance(metadata, dict):
        raise _DamagedError("metadata")
    for dtype, shape in shapes.values():
        if dtype not in _DTYPES or not all(type(size) is int and size >= 0 for size in shape):
            raise _DamagedError("shape")
    return metadata, shapes


def _header(
    identity: Mapping[str, str],
    shapes: Mapping[str, tuple[str, tuple[int, ...]]],
    checksum: str | None,
) -> bytes:
    """Return the JSON header, padded with spaces so that the arrays are aligned."""
    metadata = dict(identity) if checksum is None else {**identity, _CHECKSUM: checksum}
    content: dict[str, Any] = {"__metadata__": metadata}
    start = 0
    for name, (dtype, shape) in shapes.items():
        stop = start + math.prod(shape) * _DTYPES[dtype].itemsize
        content[name] = {"dtype": dtype, "shape": list(shape), "data_offsets": [start, stop]}
        start = stop
    text = json.dumps(content, separators=(",", ":")).encode()
    return text + b" " * (-(_LENGTH + len(text)) % _ALIGNMENT)


def _checksum(head: bytes, data: bytes | memoryview) -> str:
    digest = hashlib.sha256(head)
    digest.update(data)
    return digest.hexdigest()


@contextmanager
def _mapped(path: Path) -> Iterator[tuple[mmap.mmap, tuple[int, int, int]]]:
    """Map a file into memory for reading, and tell its stamp; an empty file is an `OSError`."""
    with path.open("rb") as file:
        status = os.fstat(file.fileno())
        if status.st_size == 0:
            raise OSError(0, "empty file", str(path))
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as memory:
            yield memory, (status.st_ino, status.st_size, status.st_mtime_ns)
