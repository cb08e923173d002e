"""Writing and reading of trial files: scene, motion, contacts, labels, and image passes on request.

`physion.trials.schema` declares the arrays; docs/trial-files.md describes the format. A file is
built in memory and then written atomically: written directly, a full disk would crash the HDF5
library, and a killed process would leave incomplete files that look complete.
"""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import h5py
import numpy as np
from numpy.typing import NDArray

from physion.atomic import write_atomic
from physion.dataclass_json import parse_json, read_dataclass
from physion.errors import BadInputError
from physion.physics.labels import Labels
from physion.physics.trajectory import Contacts, Trajectory
from physion.plain_files import read_plain
from physion.scenes.looks import in_look
from physion.scenes.scene import Scene
from physion.trials.geometry import geometry_arrays
from physion.trials.guarded_hdf5 import open_hdf5
from physion.trials.indexed_file import MAX_FILE_BYTES
from physion.trials.metadata import Metadata
from physion.trials.schema import (
    FIELDS,
    GEOMETRY,
    PASSES,
    SCHEMA,
    SEAL_BYTES,
    FieldReader,
    check_seal,
    seal,
    storage,
)

if TYPE_CHECKING:
    from physion.rendering.renderer import Frame, Renderer

T = TypeVar("T")

_STATE = ("positions", "rotations", "velocities", "angular_velocities")
_CONTACTS = ("frame", "bodies", "point", "normal", "impulse")


class TrialWriter:
    """Builder of the bytes of a trial file; equal input gives equal bytes.

    Parameters
    ----------
    metadata, trajectory, labels
        Parts of the trial.
    scene
        The scene in its free colours, whatever the look of the trial's movies.
    ids
        Ids (H, W) of frame 0: 0 is the room, i + 1 the i-th object of `Scene.names`.
    passes
        Names of image passes that will be added by `add_frame` for every frame.
    compatible
        Compress with gzip instead of zstd, for readers without hdf5plugin.
    """

    def __init__(
        self,
        metadata: Metadata,
        scene: Scene,
        trajectory: Trajectory,
        labels: Labels,
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
        self._text("labels", _to_json(labels))
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
        """Append one frame of every pass, by name; shapes as in `physion.trials.schema.PASSES`."""
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


def write_trial(
    path: Path,
    metadata: Metadata,
    scene: Scene,
    trajectory: Trajectory,
    labels: Labels,
    ids: NDArray[np.integer[Any]],
    *,
    passes: Sequence[Mapping[str, NDArray[Any]]] = (),
    compatible: bool = False,
) -> None:
    """Write a trial file to ``path`` atomically; parameters as for `TrialWriter`.

    ``passes`` has one mapping from pass name to image per frame, or is empty.
    """
    writer = TrialWriter(
        metadata,
        scene,
        trajectory,
        labels,
        ids,
        passes=sorted(passes[0]) if passes else (),
        compatible=compatible,
    )
    for images in passes:
        writer.add_frame(images)
    write_atomic(path, writer.finish())


class Trial:
    """Reader of a trial file; `Trial.open` checks the file, and parts are read on first use."""

    def __init__(self, data: bytes, where: str) -> None:
        """Check the bytes of a trial file; ``where`` names the file in errors."""
        check_seal(data, where)
        self._where = where
        self._renderers: dict[tuple[int, int, str], Renderer] = {}
        self._reader = FieldReader(open_hdf5(data, where), where)
        for path in (*FIELDS, *(GEOMETRY if self._reader.has_geometry() else ())):
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
    def labels(self) -> Labels:
        """Whether and when agent and patient touch."""
        return self._read_json(Labels, "labels")

    @cached_property
    def scene(self) -> Scene:
        """The scene in its free colours."""
        try:
            return Scene.from_json(self._reader.text("scene"))
        except BadInputError as error:
            raise BadInputError(f"{self._where}: field 'scene': {error}") from error

    def _read_json(self, kind: type[T], name: str) -> T:
        where = f"{self._where}: {name}"
        return read_dataclass(kind, parse_json(self._reader.text(name), where), where)

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
        return self._reader.array("first_frame/shares")

    @cached_property
    def geometry(self) -> dict[str, NDArray[Any]] | None:
        """Camera matrices and meshes by path (`GEOMETRY`); None for a file made without them."""
        if not self._reader.has_geometry():
            return None
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
    arrays = {"first_frame/ids": ids, "first_frame/shares": counts / ids.size}
    for name in (*_STATE, "cloth_vertices", "cloth_distance"):
        arrays[f"trajectory/{name}"] = getattr(trajectory, name)
    for name in _CONTACTS:
        arrays[f"contacts/{name}"] = getattr(trajectory.contacts, name)
    return arrays


def _to_json(value: Any) -> str:
    return json.dumps(dataclasses.asdict(value), separators=(",", ":"), sort_keys=True)
