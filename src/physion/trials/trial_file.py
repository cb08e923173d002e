"""Trial files: scene, motion, contacts, labels, and image passes on request, in HDF5 with a seal.

This module declares the arrays; docs/reference/trial-files.md describes the format. A file is built
in memory and then written atomically: written directly, a full disk would crash the HDF5
library, and a killed process would leave incomplete files that look complete.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import h5py
import hdf5plugin
import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.core.files import digest_of, read_plain
from physion.core.settings import parse_json, read_settings
from physion.physics.cloth.springs import sheet_triangles, sheet_vertices
from physion.physics.labels import Labels
from physion.physics.trajectory import Contacts, Trajectory
from physion.rendering.camera import intrinsics, view_matrix
from physion.scenes.looks import in_look
from physion.scenes.scene import Body, Cloth, Scene
from physion.scenes.shapes.primitives import shape
from physion.trials.files import MAX_FILE_BYTES, Metadata

if TYPE_CHECKING:
    from physion.rendering.renderer import Frame, Renderer


# Safe reading of HDF5 files that may be damaged or made to do harm.
#
# HDF5 can link to other files, store arrays outside the file, compress with loadable filters and
# declare sizes far beyond the file's own. The readers of trial files and of official files share
# the checks that refuse all of this before memory is allocated.

T = TypeVar("T")

_LINKS = {h5py.h5l.TYPE_SOFT: "SoftLink", h5py.h5l.TYPE_EXTERNAL: "ExternalLink"}
HDF5_ERRORS = (OSError, KeyError, RuntimeError, ValueError, TypeError, MemoryError, AttributeError)
"""Exceptions that h5py raises on damaged files."""


def open_hdf5(source: Path | bytes, where: str) -> h5py.File:
    """Open an HDF5 file, or the bytes of one, for reading.

    Raises `BadInputError`, naming ``where``, if it is none.
    """
    try:
        if isinstance(source, bytes):
            return h5py.File(h5py.h5f.open_file_image(source))
        return h5py.File(source, "r")
    except HDF5_ERRORS as error:
        raise BadInputError(f"{where} is not HDF5: {' '.join(str(error).split())}") from error


class GuardedHdf5:
    """Access to the members of an open HDF5 file, with the checks that hold for every format.

    - ``file``: the open file.
    - ``where``: name of the file in error messages.
    - ``filters``: numbers of the HDF5 filters (compression, checksums) that arrays may use.
    - ``max_chunk_bytes``: largest chunk that is read, in bytes of memory.
    """

    def __init__(
        self, file: h5py.File, where: str, *, filters: Set[int], max_chunk_bytes: int
    ) -> None:
        self.where = where
        self._file = file
        self._filters = filters
        self._max_chunk_bytes = max_chunk_bytes
        self._groups: dict[str, h5py.Group] = {}

    def bad(self, path: str, what: str) -> BadInputError:
        """Return the error that says ``what`` is wrong with the field at ``path``."""
        return BadInputError(f"{self.where}: field {path!r} {what}")

    def guard(self, path: str, read: Callable[[], T]) -> T:
        """Call ``read``; raise `BadInputError` instead of any exception of h5py."""
        try:
            return read()
        except HDF5_ERRORS as error:
            raise self.bad(path, f"cannot be read: {' '.join(str(error).split())}") from error

    def find(self, path: str) -> h5py.Group | h5py.Dataset | None:
        """Return the group or array at ``path``, or None if there is none.

        Only members stored in the file itself are returned; `BadInputError` for soft and external
        links anywhere along the path.
        """
        if path in self._groups:
            return self._groups[path]
        parents, _, name = path.rpartition("/")
        parent = self.find(parents) if parents else self._file
        if not isinstance(parent, h5py.Group):
            return None
        # The lower layer of h5py takes half the time, which counts for files of 20 small arrays.
        group, member = parent.id, name.encode()
        if not self.guard(path, lambda: group.links.exists(member)):
            return None
        kind = self.guard(path, lambda: group.links.get_info(member).type)
        if kind != h5py.h5l.TYPE_HARD:
            raise self.bad(path, f"is a {_LINKS.get(kind, 'link')}, which is not followed")
        found = self.guard(path, lambda: h5py.h5o.open(group, member))
        if isinstance(found, h5py.h5d.DatasetID):
            return h5py.Dataset(found)
        if not isinstance(found, h5py.h5g.GroupID):
            return None
        self._groups[path] = h5py.Group(found)
        return self._groups[path]

    def check_size(self, path: str, shape: tuple[int, ...], itemsize: int, max_bytes: int) -> None:
        """Check that an array of ``shape`` takes at most ``max_bytes`` of memory."""
        if math.prod(shape) * max(itemsize, 1) > max_bytes:
            raise self.bad(path, f"has shape {shape}, which is too large (limit {max_bytes} bytes)")

    def check_storage(self, path: str, dataset: h5py.Dataset) -> None:
        """Check that an array lies in this file, in chunks and with filters that are allowed."""
        self.guard(path, lambda: self._check_storage(path, dataset))

    def _check_storage(self, path: str, dataset: h5py.Dataset) -> None:
        plan = dataset.id.get_create_plist()
        if plan.get_layout() == h5py.h5d.VIRTUAL or plan.get_external_count():
            raise self.bad(path, "is stored in another file")
        unknown = {plan.get_filter(k)[0] for k in range(plan.get_nfilters())} - self._filters
        if unknown:
            raise self.bad(path, f"is packed with unknown filters {sorted(unknown)}")
        chunks = plan.get_chunk() if plan.get_layout() == h5py.h5d.CHUNKED else ()
        if math.prod(chunks) * max(dataset.dtype.itemsize, 1) > self._max_chunk_bytes:
            raise self.bad(
                path,
                f"has chunks of {chunks}, which is too large (limit {self._max_chunk_bytes} bytes)",
            )


# Layout of a trial file, and the reader that checks each field against it.
#
# A trial file is an HDF5 file that begins with a 512-byte header (an HDF5 user block, which every
# HDF5 reader skips) with the length and the SHA-256 of the file: the seal. Damage is found before
# the HDF5 library, which may crash on it, reads anything. A file made to do harm can carry a valid
# seal, so each field is checked as well before memory is allocated for it.

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

    - ``dtype``: NumPy type, or ``text``: UTF-8 of fixed length, in an array of one element.
    - ``axes``: for each axis its length, or a name; axes of one name have one length in all fields.
    - ``meaning``: what the values are, with their unit; stored as attribute ``meaning`` of the
      array.
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
    "first_frame/fractions": Field("<f4", ("thing",), "fraction of the picture by Scene.names"),
}
"""Fields with the content of a trial, by their path; every trial file has them."""

GEOMETRY: Mapping[str, Field] = {
    "camera/intrinsics": Field("<f8", (3, 3), "camera coordinates to pixels, as in OpenCV"),
    "camera/extrinsics": Field("<f8", (4, 4), "world to camera: x right, y down, z forward"),
    "meshes/vertices": Field("<f4", ("corner", 3), "all shapes one after the other, unit scale, m"),
    "meshes/faces": Field("<i4", ("face", 3), "rows of vertices, counter-clockwise from outside"),
    "meshes/ranges": Field("<i4", ("thing", 4), "first and end row of vertices, then of faces"),
    "meshes/scale": Field("<f4", ("thing", 3), "factors of the vertices; 1 for cloth"),
}
"""Fields that follow from the scene and the size of the pictures, for readers without this
package."""

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
    lines += [b"sha256 " + digest_of(rest).encode()]
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
    if head[2] != b"sha256 " + digest_of(data[SEAL_BYTES:]).encode():
        raise BadInputError(
            f"{where} is damaged: its bytes do not match their SHA-256 (field 'seal')"
        )


def storage(
    array_shape: tuple[int, ...], dtype: np.dtype[Any], compatible: bool, *, columns: bool = False
) -> dict[str, Any]:
    """Return the options with which h5py stores an array: chunks, compression, checksum.

    - ``array_shape``, ``dtype``: shape and type of the array; empty arrays get no options.
    - ``compatible``: compress with gzip, which every HDF5 reader has, instead of zstd, which reads
      five times faster.
    - ``columns``: store each column of a table with many rows as one chunk. Meshes compress to half
      the size.
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
            raise self.bad(
                path, "lies in something that is not a group" if inside else "is missing"
            )
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


# Camera matrices and meshes of a trial, as stored in its file for readers without this package.
#
# A shape is stored once, however many objects have it.


def mesh_of(thing: Body | Cloth) -> tuple[NDArray[np.float64], NDArray[np.int32]]:
    """Return vertices (V, 3) in metres and triangles (T, 3) of the surface of an object.

    Vertices of a body belong to its shape at unit scale, of a cloth to the undeformed sheet about
    its centre. Triangles are counter-clockwise as seen from outside.
    """
    if isinstance(thing, Cloth):
        flat = sheet_vertices(thing) - np.asarray(thing.position)
        return flat, sheet_triangles(thing.resolution)
    mesh = shape(thing.shape).mesh
    return mesh.vertices, mesh.faces


def geometry_arrays(scene: Scene, width: int, height: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of `GEOMETRY` by their path, in the declared types.

    ``width`` and ``height`` are the size of the pictures in pixels.
    """
    stored: dict[str, tuple[int, int, int, int]] = {}
    vertices: list[NDArray[Any]] = [np.zeros((0, 3))]
    faces: list[NDArray[Any]] = [np.zeros((0, 3), np.int32)]
    corners = triangles = 0
    ranges, scales = [], []
    things: tuple[Body | Cloth, ...] = (*scene.bodies, *scene.cloths)
    for thing in things:
        # Sheets differ in size: each is a shape of its own.
        key = f"shape {thing.shape}" if isinstance(thing, Body) else f"cloth {thing.name}"
        if key not in stored:
            points, corner_rows = mesh_of(thing)
            vertices.append(points)
            faces.append(corner_rows + corners)
            ends = corners + len(points), triangles + len(corner_rows)
            stored[key] = (corners, ends[0], triangles, ends[1])
            corners, triangles = ends
        ranges.append(stored[key])
        scales.append(thing.scale if isinstance(thing, Body) else (1.0, 1.0, 1.0))
    arrays = {
        "camera/intrinsics": intrinsics(scene.camera, width, height),
        "camera/extrinsics": view_matrix(scene.camera),
        "meshes/vertices": np.concatenate(vertices),
        "meshes/faces": np.concatenate(faces),
        "meshes/ranges": np.array(ranges).reshape(-1, 4),
        "meshes/scale": np.array(scales).reshape(-1, 3),
    }
    return {path: array.astype(GEOMETRY[path].dtype) for path, array in arrays.items()}


_STATE = ("positions", "rotations", "velocities", "angular_velocities")
_CONTACTS = ("frame", "bodies", "point", "normal", "impulse")


class TrialWriter:
    """Builder of the bytes of a trial file; equal input gives equal bytes.

    - ``metadata``, ``trajectory``, ``labels``: parts of the trial.
    - ``scene``: the scene in its free colours, whatever the look of the trial's movies.
    - ``ids``: ids (H, W) of frame 0: 0 is the room, i + 1 the i-th object of `Scene.names`.
    - ``passes``: names of image passes that will be added by `add_frame` for every frame.
    - ``compatible``: compress with gzip instead of zstd, for readers without hdf5plugin.
    """

    def __init__(
        self,
        metadata: Metadata,
        scene: Scene,
        trajectory: Trajectory,
        labels: Labels | None,
        ids: NDArray[np.integer[Any]],
        *,
        passes: Sequence[str] = (),
        compatible: bool = False,
    ) -> None:
        unknown = sorted(set(passes) - set(PASSES))
        if unknown:
            raise BadInputError(f"unknown passes {unknown}; known: {sorted(PASSES)}")
        self._buffer = io.BytesIO()
        # Format 1.10 has checksums on its metadata; every HDF5 library since 2016 reads it.
        self._file = h5py.File(
            self._buffer, "w", libver=("v110", "v110"), userblock_size=SEAL_BYTES
        )
        self._file.attrs["schema"] = np.int32(SCHEMA)
        self._compatible = compatible
        self._text("scene", scene.to_json())
        self._text("labels", "null" if labels is None else _to_json(labels))
        self._text("metadata", _to_json(metadata))
        for path, values in _arrays(trajectory, ids, len(scene.names())).items():
            array = np.asarray(values).astype(FIELDS[path].dtype)
            self._create(path, FIELDS[path].meaning, array.shape, array.dtype, array)
        for path, array in geometry_arrays(scene, metadata.width, metadata.height).items():
            self._create(path, GEOMETRY[path].meaning, array.shape, array.dtype, array)
        self._frames, self._added = len(trajectory), 0
        self._passes = {
            name: self._pass(name, len(trajectory), ids.shape) for name in sorted(set(passes))
        }

    @property
    def passes(self) -> tuple[str, ...]:
        """Names of the image passes that `add_frame` expects."""
        return tuple(self._passes)

    def add_frame(self, images: Mapping[str, NDArray[Any]]) -> None:
        """Append one frame of every pass, by name; shapes as in `PASSES`."""
        for name, dataset in self._passes.items():
            image = np.asarray(images[name])
            if image.shape != dataset.shape[1:]:
                raise BadInputError(
                    f"pass {name!r}, frame {self._added}: {image.shape}, not {dataset.shape[1:]}"
                )
            # In half precision a flow of more than 65504 pixels becomes infinite.
            with np.errstate(over="ignore"):
                dataset[self._added] = image.astype(dataset.dtype)
        self._added += 1

    def finish(self) -> bytes:
        """Close the file and return its bytes."""
        if self._passes and self._added != self._frames:
            raise BadInputError(f"trial got {self._added} frames of passes, not {self._frames}")
        self._file.close()
        return seal(self._buffer.getvalue())

    def _text(self, path: str, text: str) -> None:
        array = np.array([text.encode("utf-8")])
        self._create(path, FIELDS[path].meaning, (1,), array.dtype, array)

    def _pass(self, name: str, frames: int, size: tuple[int, ...]) -> h5py.Dataset:
        field = PASSES[name]
        shape = (frames, *size, *(axis for axis in field.axes if isinstance(axis, int)))
        dtype = np.dtype(field.dtype)
        options = {**storage(shape, dtype, self._compatible), "chunks": (1, *shape[1:])}
        dataset = self._file.create_dataset(f"passes/{name}", shape, dtype, **options)
        dataset.attrs["meaning"] = np.bytes_(field.meaning.encode())
        return dataset

    def _create(
        self, path: str, meaning: str, shape: tuple[int, ...], dtype: np.dtype[Any], array: Any
    ) -> None:
        options = storage(shape, dtype, self._compatible, columns=path in GEOMETRY)
        dataset = self._file.create_dataset(path, data=array, **options)
        dataset.attrs["meaning"] = np.bytes_(meaning.encode())


class Trial:
    """Reader of a trial file; `Trial.open` checks the file, and parts are read on first use."""

    def __init__(self, data: bytes, where: str) -> None:
        """Check the bytes of a trial file; ``where`` names the file in errors."""
        check_seal(data, where)
        self._where = where
        self._renderers: dict[tuple[int, int, str], Renderer] = {}
        self._reader = FieldReader(open_hdf5(data, where), where)
        for path in (*FIELDS, *GEOMETRY):
            self._reader.check(path)
        for name in self.pass_names:
            self._reader.check(f"passes/{name}")

    @classmethod
    def open(cls, path: Path) -> Trial:
        """Open the trial file at ``path``; `BadInputError` names file and field if it is bad."""
        try:
            data = read_plain(path, MAX_FILE_BYTES, follow_links=True)
        except BadInputError as error:
            raise BadInputError(f"trial file {error}") from error
        return cls(data, f"trial file {path}")

    @cached_property
    def metadata(self) -> Metadata:
        """Origin and settings of the trial."""
        metadata = self._read_json(Metadata, "metadata")
        metadata.check(self._where)
        return metadata

    @cached_property
    def labels(self) -> Labels | None:
        """Whether and when agent and patient touch; None if the trial is stored without labels."""
        if self._reader.text("labels") == "null":
            return None
        return self._read_json(Labels, "labels")

    def known_labels(self) -> Labels:
        """Return the labels; raise `BadInputError` if the trial is stored without."""
        if self.labels is None:
            raise BadInputError(f"{self._where} is stored without labels, which are needed here")
        return self.labels

    @cached_property
    def scene(self) -> Scene:
        """The scene in its free colours."""
        try:
            return Scene.from_json(self._reader.text("scene"))
        except BadInputError as error:
            raise BadInputError(f"{self._where}: field 'scene': {error}") from error

    def _read_json(self, kind: type[T], name: str) -> T:
        where = f"{self._where}: {name}"
        return read_settings(kind, parse_json(self._reader.text(name), where), where)

    def shown(self, look: str | None = None) -> Scene:
        """Return the scene in the colours of ``look``, by default the trial's own."""
        return in_look(self.scene, self.metadata.look if look is None else look)

    @cached_property
    def trajectory(self) -> Trajectory:
        """Motion of the trial; `BadInputError` if it does not match the scene."""
        contacts = Contacts(**{name: self._reader.array(f"contacts/{name}") for name in _CONTACTS})
        arrays = {name: self._reader.array(f"trajectory/{name}") for name in _STATE}
        frames, bodies = arrays["positions"].shape[:2]
        things = len(self.scene.names())
        if bodies != len(self.scene.bodies) or frames != self.metadata.frames or frames < 1:
            raise BadInputError(
                f"{self._where}: field 'trajectory/positions' has {frames} frames of {bodies} "
                f"bodies, the scene {self.metadata.frames} of {len(self.scene.bodies)}"
            )
        for name, values, low, high in (
            ("frame", contacts.frame, 0, frames),
            ("bodies", contacts.bodies, -1, things),
        ):
            if values.size and (values.min() < low or values.max() >= high):
                raise BadInputError(
                    f"{self._where}: field 'contacts/{name}' leaves {low}..{high - 1}"
                )
        arrays["cloth_vertices"] = self._reader.array("trajectory/cloth_vertices")
        self._check_finite(arrays)
        return Trajectory(
            **arrays,
            cloth_distance=self._reader.array("trajectory/cloth_distance"),
            contacts=contacts,
            completed=self.metadata.completed,
            engine=self.metadata.engine,
        )

    def _check_finite(self, arrays: Mapping[str, NDArray[Any]]) -> None:
        """Raise `BadInputError` for infinite values, and for NaN in motions that were simulated.

        A motion that was imported may be unknown, which is NaN.
        """
        bad = np.isinf if self.metadata.imported else lambda values: ~np.isfinite(values)
        for name, values in arrays.items():
            if bad(values).any():
                raise BadInputError(
                    f"{self._where}: field 'trajectory/{name}' has values that are not finite"
                )

    @cached_property
    def ids(self) -> NDArray[np.int16]:
        """Ids (H, W) of frame 0: 0 is the room, i + 1 the i-th object of `Scene.names`."""
        ids: NDArray[np.int16] = self._reader.array("first_frame/ids")
        things = len(self.scene.names())
        if ids.size and (ids.min() < 0 or ids.max() > things):
            raise BadInputError(f"{self._where}: field 'first_frame/ids' leaves 0..{things}")
        return ids

    @cached_property
    def pixel_fractions(self) -> NDArray[np.float32]:
        """Fraction of the pixels of frame 0 that show each object of `Scene.names`: (N,), 0..1."""
        return self._reader.array("first_frame/fractions")

    @cached_property
    def geometry(self) -> dict[str, NDArray[Any]]:
        """Camera matrices and meshes by path (`GEOMETRY`)."""
        return {path: self._reader.array(path) for path in GEOMETRY}

    @cached_property
    def pass_names(self) -> tuple[str, ...]:
        """Names of the image passes that the file stores, by default none."""
        return self._reader.passes()

    def passes(self, frame: int) -> dict[str, NDArray[Any]]:
        """Return the stored image passes of one frame by name; `BadInputError` if it is absent."""
        if not 0 <= frame < self.metadata.frames:
            raise BadInputError(f"{self._where} has no frame {frame} of {self.metadata.frames}")
        return {name: self._reader.image(name, frame) for name in self.pass_names}

    def render(
        self, frame: int, passes: Sequence[str] = ("color",), look: str | None = None
    ) -> Frame:
        """Render image passes of a frame from the stored state, whether they are stored or not.

        ``look`` is ``redyellow`` or ``free``, by default the trial's own.
        """
        return self.renderer(look=look).render(frame, passes)

    def renderer(
        self, width: int | None = None, height: int | None = None, look: str | None = None
    ) -> Renderer:
        """Return a (cached) renderer of the trial, by default in the trial's own size and look."""
        # Imported late: loading the compiled renderer takes time.
        from physion.rendering.renderer import Renderer

        meta = self.metadata
        key = (width or meta.width, height or meta.height, look or meta.look)
        if key not in self._renderers:
            self._renderers[key] = Renderer(self.shown(key[2]), self.trajectory, *key[:2])
        return self._renderers[key]


def _arrays(trajectory: Trajectory, ids: NDArray[Any], things: int) -> dict[str, NDArray[Any]]:
    """Return the arrays of a trial by the path of their field."""
    if ids.ndim != 2 or not ids.size or ids.min() < 0 or ids.max() > things:
        raise BadInputError(f"ids of shape {ids.shape} are not pixels in 0..{things}")
    counts = np.bincount(ids.ravel(), minlength=things + 1)[1:]
    arrays = {"first_frame/ids": ids, "first_frame/fractions": counts / ids.size}
    for name in (*_STATE, "cloth_vertices", "cloth_distance"):
        arrays[f"trajectory/{name}"] = getattr(trajectory, name)
    for name in _CONTACTS:
        arrays[f"contacts/{name}"] = getattr(trajectory.contacts, name)
    return arrays


def _to_json(value: Any) -> str:
    return json.dumps(dataclasses.asdict(value), separators=(",", ":"), sort_keys=True)
