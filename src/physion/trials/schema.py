"""Layout of a trial file, and the reader that checks each field against it.

A trial file is an HDF5 file that begins with a 512-byte header (an HDF5 user block, which every
HDF5 reader skips) with the length and the SHA-256 of the file: the seal. Damage is found before
the HDF5 library, which may crash on it, reads anything. A file made to do harm can carry a valid
seal, so each field is checked as well before memory is allocated for it; see
`physion.trials.guarded_hdf5`.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import h5py
import hdf5plugin
import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.trials.guarded_hdf5 import GuardedHdf5

SCHEMA = 2
"""Version of the layout, raised when a reader of the old layout could misread the new one."""
SEAL_BYTES = 512
MAX_FIELD_BYTES = 2**31
"""Largest field that is read, in bytes of memory: 24 minutes of 256 x 256 colour."""
MAX_CHUNK_BYTES = 2**28
"""Largest chunk that is read, in bytes of memory."""
WHOLE_BYTES = 2**20
"""Fields up to this many bytes are stored as one chunk, larger ones as one chunk per frame."""
TALL = 64
"""Rows from which a chunk for each column of a table saves more than it costs."""

_MAGIC = b"PHYSION TRIAL"
_ZSTD = 32015
"""Registered number of the Zstandard filter."""
_FILTERS = {h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32, h5py.h5z.FILTER_DEFLATE, _ZSTD}


@dataclass(frozen=True)
class Field:
    """Declaration of one array of a trial file.

    Parameters
    ----------
    dtype
        NumPy type, or ``text``: UTF-8 of fixed length, in an array of one element.
    axes
        For each axis its length, or a name; axes of one name have one length in all fields.
    meaning
        What the values are, with their unit; stored as attribute ``meaning`` of the array.
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
"""Fields that every trial file has, by their path."""

GEOMETRY: Mapping[str, Field] = {
    "camera/intrinsics": Field("<f8", (3, 3), "camera coordinates to pixels, as in OpenCV"),
    "camera/extrinsics": Field("<f8", (4, 4), "world to camera: x right, y down, z forward"),
    "meshes/vertices": Field("<f4", ("corner", 3), "all shapes one after the other, unit scale, m"),
    "meshes/faces": Field("<i4", ("face", 3), "rows of vertices, counter-clockwise from outside"),
    "meshes/ranges": Field("<i4", ("thing", 4), "first and end row of vertices, then of faces"),
    "meshes/scale": Field("<f4", ("thing", 3), "factors of the vertices; 1 for cloth"),
}
"""Fields that follow from the scene and the size of the pictures, for readers without this package.
Files that were made before they existed lack all of them."""

PASSES: Mapping[str, Field] = {
    "color": Field("|u1", ("frame", "row", "column", 3), "sRGB"),
    "depth": Field("<f4", ("frame", "row", "column"), "distance along the view axis, m"),
    "normals": Field("<f2", ("frame", "row", "column", 3), "unit, world axes"),
    "ids": Field("<i2", ("frame", "row", "column"), "0 the room, i + 1 the i-th of Scene.names"),
    "flow": Field("<f2", ("frame", "row", "column", 2), "(right, down), pixels"),
}
"""Image passes that can be stored under ``passes/``, one chunk per frame."""
_ARRAYS = {**FIELDS, **GEOMETRY, **{f"passes/{name}": field for name, field in PASSES.items()}}


def seal(content: bytes) -> bytes:
    """Return ``content`` with its length and SHA-256 written into its first 512 bytes."""
    rest = content[SEAL_BYTES:]
    lines = [_MAGIC + b" %d" % SCHEMA, b"length %d" % len(content)]
    lines += [b"sha256 " + hashlib.sha256(rest).hexdigest().encode()]
    return (b"\n".join(lines) + b"\n").ljust(SEAL_BYTES, b"\0") + rest


def check_seal(data: bytes, where: str) -> None:
    """Raise `BadInputError` unless ``data`` is a whole, unchanged file of this schema version."""
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
            f"{where} is cut short or too long: {len(data)} bytes, not {promised} (field 'seal')"
        )
    if head[2] != b"sha256 " + hashlib.sha256(data[SEAL_BYTES:]).hexdigest().encode():
        raise BadInputError(
            f"{where} is damaged: its bytes do not match their SHA-256 (field 'seal')"
        )


def storage(
    array_shape: tuple[int, ...], dtype: np.dtype[Any], compatible: bool, *, columns: bool = False
) -> dict[str, Any]:
    """Return the options with which h5py stores an array: chunks, compression, checksum.

    Parameters
    ----------
    array_shape, dtype
        Shape and type of the array; empty arrays get no options.
    compatible
        Compress with gzip, which every HDF5 reader has, instead of zstd, which reads five times
        faster.
    columns
        Store each column of a table with many rows as one chunk. Meshes compress to half the size.
    """
    size = int(np.prod(array_shape)) * dtype.itemsize
    if size == 0:
        return {}
    chunks = array_shape if size <= WHOLE_BYTES else (1, *array_shape[1:])
    if columns and array_shape[0] >= TALL:
        chunks = (array_shape[0], 1)
    packed = {"compression": "gzip", "compression_opts": 4}
    zstd: Mapping[str, Any] = hdf5plugin.Zstd(clevel=3)
    return {
        "chunks": chunks,
        "shuffle": True,
        "fletcher32": True,
        **(packed if compatible else zstd),
    }


class FieldReader(GuardedHdf5):
    """Reader of the fields of one open trial file; checks each against its declaration.

    ``where`` names the file in errors. Axes of one name must have the same length in all fields.
    """

    def __init__(self, file: h5py.File, where: str) -> None:
        super().__init__(file, where, filters=_FILTERS, max_chunk_bytes=MAX_CHUNK_BYTES)
        self._lengths: dict[str, int] = {}
        self._checked: dict[str, h5py.Dataset] = {}

    def text(self, path: str) -> str:
        """Return the text at ``path``."""
        dataset = self._dataset(path, FIELDS[path])
        return self.guard(path, lambda: bytes(dataset[0]).decode("utf-8"))

    def array(self, path: str) -> NDArray[Any]:
        """Return the whole array of the declared field at ``path``."""
        dataset = self._dataset(path, _ARRAYS[path])
        values = np.empty(dataset.shape, _ARRAYS[path].dtype)
        if values.size:
            # The lower layer of h5py, as in `GuardedHdf5.find`.
            self.guard(path, lambda: dataset.id.read(h5py.h5s.ALL, h5py.h5s.ALL, values))
        return values

    def image(self, name: str, frame: int) -> NDArray[Any]:
        """Return one frame of the image pass ``name``."""
        path = f"passes/{name}"
        dataset = self._dataset(path, PASSES[name])
        return np.asarray(self.guard(path, lambda: dataset[frame]))

    def passes(self) -> tuple[str, ...]:
        """Return the names of the image passes that the file holds."""
        group = self.find("passes")
        if group is None:
            return ()
        if not isinstance(group, h5py.Group):
            raise self.bad("passes", "is not a group")
        return self.guard("passes", lambda: tuple(name for name in PASSES if name in group))

    def has_geometry(self) -> bool:
        """Return whether the file holds any of `GEOMETRY`; then it must hold all."""
        return self.find("camera") is not None or self.find("meshes") is not None

    def check(self, path: str) -> None:
        """Check the field at ``path`` against its declaration without reading its values."""
        self._dataset(path, _ARRAYS[path])

    def _dataset(self, path: str, field: Field) -> h5py.Dataset:
        """Return the array at ``path``, checked against ``field`` the first time it is used."""
        if path in self._checked:
            return self._checked[path]
        dataset = self.find(path)
        if dataset is None:
            parent = self.find(path.rpartition("/")[0]) if "/" in path else None
            inside = isinstance(parent, h5py.Dataset)
            raise self.bad(path, "lies in something that is no group" if inside else "is missing")
        if not isinstance(dataset, h5py.Dataset):
            raise self.bad(path, "is not an array")
        self.guard(path, lambda: self._check_layout(path, dataset))
        self.check_storage(path, dataset)
        self.guard(path, lambda: self._check_type(path, dataset, field))
        self._check_shape(path, dataset.shape, field)
        self._checked[path] = dataset
        return dataset

    def _check_layout(self, path: str, dataset: h5py.Dataset) -> None:
        """Check that the array is stored in chunks, which carry checksums, unless it is empty."""
        layout = dataset.id.get_create_plist().get_layout()
        empty = layout == h5py.h5d.CONTIGUOUS and 0 in (dataset.shape or (1,))
        if layout != h5py.h5d.CHUNKED and not empty:
            raise self.bad(path, "is not stored in chunks")

    def _check_type(self, path: str, dataset: h5py.Dataset, field: Field) -> None:
        kind = dataset.id.get_type()
        if field.dtype == "text":
            if not isinstance(kind, h5py.h5t.TypeStringID) or kind.is_variable_str():
                raise self.bad(path, "is not text of fixed length")
        elif dataset.dtype != np.dtype(field.dtype):
            raise self.bad(path, f"has type {dataset.dtype}, not {np.dtype(field.dtype)}")

    def _check_shape(self, path: str, shape: tuple[int, ...] | None, field: Field) -> None:
        if shape is None or len(shape) != len(field.axes):
            raise self.bad(path, f"has shape {shape}, not {field.axes}")
        itemsize = 1 if field.dtype == "text" else np.dtype(field.dtype).itemsize
        self.check_size(path, shape, itemsize, MAX_FIELD_BYTES)
        for axis, length in zip(field.axes, shape, strict=True):
            expected = axis if isinstance(axis, int) else self._lengths.setdefault(axis, length)
            if length != expected:
                raise self.bad(path, f"has {length} entries along axis {axis!r}, not {expected}")
