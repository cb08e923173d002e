"""The layout of a trial file, and how its fields are read without trusting the file.

A trial file is HDF5 behind a seal: the first 512 bytes (an HDF5 user block, which every HDF5
reader skips) hold the length and the SHA-256 of the rest. Damage is found before the HDF5
library, which may crash on it, sees a byte. A file that was made to harm can carry a right seal,
so each field is checked as well before memory is given to it: no links out of the file, no types
that run code or point elsewhere, no size beyond the limits.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import hdf5plugin
import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError

SCHEMA = 2
"""Version of the layout; it rises when a reader of the old one could misread the new one."""
SEAL_BYTES = 512
MAX_FIELD_BYTES = 2**31
"""Largest field that is read, in memory: 24 minutes of 256 x 256 colour."""
MAX_CHUNK_BYTES = 2**28
WHOLE_BYTES = 2**20
"""Fields up to this size are one chunk: a chunk a frame would cost more than the numbers."""

_MAGIC = b"PHYSION TRIAL"
_FILTERS = {h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32, h5py.h5z.FILTER_DEFLATE, 32015}
_HDF5_ERRORS = (OSError, KeyError, RuntimeError, ValueError, TypeError, MemoryError, AttributeError)
"""What h5py raises on files that are not what they say."""


@dataclass(frozen=True)
class Field:
    """One array of a trial file: its type, what its axes count, and what it means.

    An axis is a name whose length is the same in all fields, or a fixed number. Type ``text`` is
    UTF-8 of fixed length, in an array of one element.
    """

    dtype: str
    axes: tuple[str | int, ...]
    meaning: str


FIELDS: Mapping[str, Field] = {
    "scene": Field("text", (1,), "Scene.to_json, in its free colours"),
    "labels": Field("text", (1,), "Labels as JSON"),
    "metadata": Field("text", (1,), "Metadata as JSON"),
    "trajectory/positions": Field("<f4", ("frame", "body", 3), "pivots, m"),
    "trajectory/rotations": Field("<f4", ("frame", "body", 4), "unit quaternions (w, x, y, z)"),
    "trajectory/velocities": Field("<f4", ("frame", "body", 3), "of the centre of mass, m/s"),
    "trajectory/angular_velocities": Field("<f4", ("frame", "body", 3), "world axes, rad/s"),
    "trajectory/cloth_vertices": Field("<f4", ("frame", "vertex", 3), "m"),
    "trajectory/cloth_distance": Field("<f4", ("frame",), "gap cloth to solid, m; NaN without"),
    "contacts/frame": Field("<i4", ("contact",), "frame that shows the touch"),
    "contacts/bodies": Field("<i4", ("contact", 2), "indices of Scene.names, -1 the floor"),
    "contacts/point": Field("<f4", ("contact", 3), "m"),
    "contacts/normal": Field("<f4", ("contact", 3), "unit, from the first to the second body"),
    "contacts/impulse": Field("<f4", ("contact",), "N s along the normal"),
    "first_frame/ids": Field("<i2", ("row", "column"), "0 the room, i + 1 the i-th of Scene.names"),
    "first_frame/shares": Field("<f4", ("thing",), "share of the picture by Scene.names"),
}
"""Fields that every trial file has, by path."""

PASSES: Mapping[str, Field] = {
    "color": Field("|u1", ("frame", "row", "column", 3), "sRGB"),
    "depth": Field("<f4", ("frame", "row", "column"), "distance along the view axis, m"),
    "normals": Field("<f2", ("frame", "row", "column", 3), "unit, world axes"),
    "ids": Field("<i2", ("frame", "row", "column"), "0 the room, i + 1 the i-th of Scene.names"),
    "flow": Field("<f2", ("frame", "row", "column", 2), "(right, down), pixels"),
}
"""Image passes, kept under ``passes/`` when asked for, one frame a chunk."""


def seal(content: bytes) -> bytes:
    """``content``, whose first 512 bytes are free, with its length and SHA-256 written there."""
    rest = content[SEAL_BYTES:]
    lines = [_MAGIC + b" %d" % SCHEMA, b"length %d" % len(content)]
    lines += [b"sha256 " + hashlib.sha256(rest).hexdigest().encode()]
    return (b"\n".join(lines) + b"\n").ljust(SEAL_BYTES, b"\0") + rest


def check_seal(data: bytes, where: str) -> None:
    """Raise `BadInputError` unless ``data`` is a whole, unchanged trial file of our version."""
    head = data[:SEAL_BYTES].rstrip(b"\0").split(b"\n")
    if not data:
        raise BadInputError(f"{where} is empty")
    if not head[0].startswith(_MAGIC) or len(head) < 3:
        raise BadInputError(f"{where} is not a trial file (field 'seal')")
    version = head[0].removeprefix(_MAGIC).strip()
    if version != b"%d" % SCHEMA:
        raise BadInputError(
            f"{where} has schema {version.decode('ascii', 'replace')}, this physion reads {SCHEMA}"
        )
    if head[1] != b"length %d" % len(data):
        promised = head[1].removeprefix(b"length ").decode("ascii", "replace")
        raise BadInputError(
            f"{where} is cut short or grown: {len(data)} bytes, not {promised} (field 'seal')"
        )
    if head[2] != b"sha256 " + hashlib.sha256(data[SEAL_BYTES:]).hexdigest().encode():
        raise BadInputError(
            f"{where} is damaged: its bytes do not fit their SHA-256 (field 'seal')"
        )


def storage(array_shape: tuple[int, ...], dtype: np.dtype[Any], compatible: bool) -> dict[str, Any]:
    """How h5py shall store an array: chunks, compression, checksum.

    ``compatible`` chooses gzip, which every reader has, over zstd, which reads five times faster.
    """
    size = int(np.prod(array_shape)) * dtype.itemsize
    if size == 0:
        return {}
    chunks = array_shape if size <= WHOLE_BYTES else (1, *array_shape[1:])
    packed = {"compression": "gzip", "compression_opts": 4}
    zstd: Mapping[str, Any] = hdf5plugin.Zstd(clevel=3)
    return {
        "chunks": chunks,
        "shuffle": True,
        "fletcher32": True,
        **(packed if compatible else zstd),
    }


class FieldReader:
    """Reads fields of one open trial file, checking each against its declaration.

    Axes of one name must have one length in all fields. ``where`` names the file in errors.
    """

    def __init__(self, file: h5py.File, where: str) -> None:
        self.where = where
        self._file = file
        self._lengths: dict[str, int] = {}
        self._known: dict[str, h5py.Dataset] = {}
        self._groups: dict[str, Any] = {}

    def text(self, path: str) -> str:
        """The text at ``path``."""
        dataset = self._checked(path, FIELDS[path])
        value = self._guard(path, lambda: bytes(dataset[0]).decode("utf-8"))
        return str(value)

    def array(self, path: str) -> NDArray[Any]:
        """The array at ``path`` of the declared fields, whole."""
        dataset = self._checked(path, FIELDS[path])
        return np.asarray(self._guard(path, lambda: dataset[()]))

    def image(self, name: str, frame: int) -> NDArray[Any]:
        """One frame of the pass ``name``."""
        path = f"passes/{name}"
        dataset = self._checked(path, PASSES[name])
        return np.asarray(self._guard(path, lambda: dataset[frame]))

    def passes(self) -> tuple[str, ...]:
        """Names of the image passes that the file holds."""
        group = self._member(self._file, "passes", "passes", optional=True)
        if group is None:
            return ()
        if not isinstance(group, h5py.Group):
            raise self._bad("passes", "is not a group")
        return tuple(self._guard("passes", lambda: [name for name in PASSES if name in group]))

    def check(self, path: str) -> None:
        """Check the declaration of the field at ``path`` without reading its values."""
        self._checked(path, FIELDS[path] if path in FIELDS else PASSES[path.split("/")[1]])

    def _checked(self, path: str, field: Field) -> h5py.Dataset:
        if path in self._known:
            return self._known[path]
        *groups, name = path.split("/")
        parent: Any = self._file
        for group in groups:
            if group not in self._groups:
                self._groups[group] = self._member(parent, group, path)
            parent = self._groups[group]
        dataset = self._member(parent, name, path)
        if not isinstance(dataset, h5py.Dataset):
            raise self._bad(path, "is not an array")
        self._guard(path, lambda: self._check_storage(path, dataset))
        self._guard(path, lambda: self._check_type(path, dataset, field))
        self._check_shape(path, dataset.shape, field)
        self._known[path] = dataset
        return dataset

    def _member(self, group: Any, name: str, path: str, optional: bool = False) -> Any:
        """A member that lies in this very file: links elsewhere are refused, not followed."""
        if not isinstance(group, h5py.Group):
            raise self._bad(path, "lies in something that is no group")
        link = self._guard(path, lambda: group.get(name, getlink=True))
        if link is None:
            if optional:
                return None
            raise self._bad(path, "is missing")
        if not isinstance(link, h5py.HardLink):
            raise self._bad(path, f"is a {type(link).__name__}, which trial files may not have")
        return self._guard(path, lambda: group[name])

    def _check_storage(self, path: str, dataset: h5py.Dataset) -> None:
        plan = dataset.id.get_create_plist()
        layout = plan.get_layout()
        if layout == h5py.h5d.CONTIGUOUS and 0 in (dataset.shape or (1,)):
            if plan.get_external_count():
                raise self._bad(path, "is stored in another file")
            return
        if layout != h5py.h5d.CHUNKED:
            raise self._bad(path, "is not stored in chunks")
        filters = {plan.get_filter(index)[0] for index in range(plan.get_nfilters())}
        if not filters <= _FILTERS:
            raise self._bad(path, f"is packed with unknown filters {sorted(filters - _FILTERS)}")
        if int(np.prod(dataset.chunks, dtype=object)) * dataset.dtype.itemsize > MAX_CHUNK_BYTES:
            raise self._bad(path, f"has chunks of {dataset.chunks}, which is too large")

    def _check_type(self, path: str, dataset: h5py.Dataset, field: Field) -> None:
        kind = dataset.id.get_type()
        if field.dtype == "text":
            if not isinstance(kind, h5py.h5t.TypeStringID) or kind.is_variable_str():
                raise self._bad(path, "is not text of fixed length")
        elif dataset.dtype != np.dtype(field.dtype):
            raise self._bad(path, f"has type {dataset.dtype}, not {np.dtype(field.dtype)}")

    def _check_shape(self, path: str, shape: tuple[int, ...] | None, field: Field) -> None:
        if shape is None or len(shape) != len(field.axes):
            raise self._bad(path, f"has shape {shape}, not {field.axes}")
        itemsize = 1 if field.dtype == "text" else np.dtype(field.dtype).itemsize
        if int(np.prod(shape, dtype=object)) * itemsize > MAX_FIELD_BYTES:
            raise self._bad(path, f"claims shape {shape}, which is too large to be true")
        for axis, length in zip(field.axes, shape, strict=True):
            expected = axis if isinstance(axis, int) else self._lengths.setdefault(axis, length)
            if length != expected:
                raise self._bad(path, f"has {length} entries along axis {axis!r}, not {expected}")

    def _guard(self, path: str, read: Callable[[], Any]) -> Any:
        """Call ``read`` and turn what HDF5 says about broken files into our one error."""
        try:
            return read()
        except _HDF5_ERRORS as error:
            raise self._bad(path, f"cannot be read: {' '.join(str(error).split())}") from error

    def _bad(self, path: str, what: str) -> BadInputError:
        return BadInputError(f"{self.where}: field {path!r} {what}")


def open_image(data: bytes, where: str) -> h5py.File:
    """Open the bytes of a trial file for reading; `BadInputError` if HDF5 cannot."""
    import io

    try:
        return h5py.File(io.BytesIO(data), "r")
    except _HDF5_ERRORS as error:
        raise BadInputError(f"{where} is not HDF5: {' '.join(str(error).split())}") from error
