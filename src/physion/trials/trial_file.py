"""One trial in one file: scene, motion, contacts, labels, first-frame ids, and passes if wanted.

The file is built in memory and written at once, because the HDF5 library crashes the process when
the disk is full, and leaves files that look whole when it is killed.
"""

from __future__ import annotations

import dataclasses
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from physion.scenes.looks import with_role_colors
from physion.scenes.scene import Scene
from physion.trials.guarded_hdf5 import open_hdf5
from physion.trials.schema import (
    FIELDS,
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

LOOKS = ("redyellow", "free")
"""Red agent and yellow patient, or the colours that the scene was drawn with."""

_STATE = ("positions", "rotations", "velocities", "angular_velocities")
_CONTACTS = ("frame", "bodies", "point", "normal", "impulse")


@dataclass(frozen=True)
class Metadata:
    """Where a trial comes from and how it was made. Nothing of it depends on the clock.

    - ``trial``: its name, unique in the dataset. ``index``: its place in its split, from 0.
    - ``preset``: name of the scenario's parameter set; None for an imported scene.
    - ``seed``: entropy of its `SeedSequence` in hexadecimal; None for an imported scene.
      ``attempt``: how many draws of this trial were refused before, None for an imported scene.
    - ``scene_digest``: of all that decides the motion (`Scene.physics_digest`).
    - ``look``: ``redyellow`` or ``free``. ``movies``: there are movies and a map, and
      ``free_movies``: also movies in free colours.
      ``width``, ``height``: pixels.
    - ``frames``: of the whole trial; ``observed_frames``: those that may be seen by who predicts.
    - ``frame_time``: seconds of physics in a frame. ``playback_rate``: movie frames a second.
    - ``completed``: everything came to rest, rather than the time being over.
    - ``engine``, ``renderer``, ``package``: names with versions. ``digest``: of the trajectory.
    - ``recorded_contact``: the outcome that an imported scene came with, else None.
    """

    trial: str
    dataset: str
    scenario: str
    split: str
    index: int
    preset: str | None
    seed: str | None
    look: str
    width: int
    height: int
    frames: int
    observed_frames: int
    frame_time: float
    playback_rate: int
    completed: bool
    engine: str
    renderer: str
    package: str
    digest: str
    scene_digest: str
    attempt: int | None = None
    movies: bool = True
    free_movies: bool = False
    recorded_contact: bool | None = None

    @property
    def physics_seconds(self) -> float:
        """How long the trial lasts in the world."""
        return (self.frames - 1) * self.frame_time

    @property
    def playback_seconds(self) -> float:
        """How long its movie lasts."""
        return self.frames / self.playback_rate


class TrialWriter:
    """Builds the bytes of a trial file; image passes come frame by frame, if there are any.

    ``scene`` comes in its free colours, whatever look the trial's movies have.

    ``ids`` (H, W) says what each pixel of frame 0 shows: 0 the room, i + 1 the i-th of
    `Scene.names`, as the renderer has it. ``passes`` are the names that every `add_frame` brings.
    ``compatible`` packs with gzip, for readers without hdf5plugin. Same input, same bytes.
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
        # Format 1.10 has checksums on its own structure, and is read by every HDF5 since 2016.
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
        self._frames, self._added = len(trajectory), 0
        self._passes = {
            name: self._pass(name, len(trajectory), ids.shape) for name in sorted(set(passes))
        }

    @property
    def passes(self) -> tuple[str, ...]:
        """Names of the image passes that every `add_frame` brings."""
        return tuple(self._passes)

    def add_frame(self, images: Mapping[str, NDArray[Any]]) -> None:
        """Append one frame of every pass; shapes as in `physion.trials.schema.PASSES`."""
        for name, dataset in self._passes.items():
            image = np.asarray(images[name])
            if image.shape != dataset.shape[1:]:
                raise BadInputError(
                    f"pass {name!r}, frame {self._added}: {image.shape}, not {dataset.shape[1:]}"
                )
            # A flow past 65504 pixels is as good as infinite, and becomes so.
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
        options = storage(shape, dtype, self._compatible)
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
    """Write a whole trial file to ``path``, atomically; arguments as `TrialWriter` takes them.

    ``passes`` holds one mapping from pass name to image for each frame, or nothing.
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
    """A trial file, opened for reading. `Trial.open` checks it; parts are read when asked for."""

    def __init__(self, data: bytes, where: str) -> None:
        """Open the bytes of a trial file; ``where`` names it in errors. See `Trial.open`."""
        check_seal(data, where)
        self._where = where
        self._renderers: dict[tuple[int, int, str], Renderer] = {}
        self._reader = FieldReader(open_hdf5(io.BytesIO(data), where), where)
        for path in FIELDS:
            self._reader.check(path)
        for name in self.pass_names:
            self._reader.check(f"passes/{name}")

    @classmethod
    def open(cls, path: Path) -> Trial:
        """Open the trial file at ``path``; `BadInputError` names file and field if it is bad."""
        try:
            data = path.read_bytes()
        except OSError as error:
            raise BadInputError(f"trial file {path} cannot be read: {error.strerror}") from error
        return cls(data, f"trial file {path}")

    @cached_property
    def metadata(self) -> Metadata:
        """Where the trial comes from."""
        return self._read_json(Metadata, "metadata")

    @cached_property
    def labels(self) -> Labels:
        """Whether and when agent and patient touch."""
        return self._read_json(Labels, "labels")

    @cached_property
    def scene(self) -> Scene:
        """What is in the trial, in its free colours."""
        try:
            return Scene.from_json(self._reader.text("scene"))
        except BadInputError as error:
            raise BadInputError(f"{self._where}: field 'scene': {error}") from error

    def _read_json(self, kind: type[T], name: str) -> T:
        where = f"{self._where}: {name}"
        return read_dataclass(kind, parse_json(self._reader.text(name), where), where)

    def shown(self, look: str | None = None) -> Scene:
        """The scene in the colours of a look: ``redyellow``, ``free``, or the trial's own."""
        return in_look(self.scene, self.metadata.look if look is None else look)

    @cached_property
    def trajectory(self) -> Trajectory:
        """How it moved. `BadInputError` where it does not fit the scene."""
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
        return Trajectory(
            **arrays,
            cloth_vertices=self._reader.array("trajectory/cloth_vertices"),
            cloth_distance=self._reader.array("trajectory/cloth_distance"),
            contacts=contacts,
            completed=self.metadata.completed,
            engine=self.metadata.engine,
        )

    @cached_property
    def ids(self) -> NDArray[np.int16]:
        """What each pixel of frame 0 shows (H, W): 0 the room, i + 1 the i-th of `Scene.names`."""
        return self._reader.array("first_frame/ids")

    @cached_property
    def shares(self) -> NDArray[np.float32]:
        """Share of frame 0 that each thing of `Scene.names` covers: (N,), 0..1."""
        return self._reader.array("first_frame/shares")

    @cached_property
    def pass_names(self) -> tuple[str, ...]:
        """Image passes that the file holds, often none."""
        return self._reader.passes()

    def passes(self, frame: int) -> dict[str, NDArray[Any]]:
        """The stored image passes of one frame by name; `BadInputError` where there is no frame."""
        if not 0 <= frame < self.metadata.frames:
            raise BadInputError(f"{self._where} has no frame {frame} of {self.metadata.frames}")
        return {name: self._reader.image(name, frame) for name in self.pass_names}

    def render(
        self, frame: int, passes: Sequence[str] = ("color",), look: str | None = None
    ) -> Frame:
        """Any pass of any frame, rendered again from the stored state, stored or not.

        ``look`` is ``redyellow`` or ``free``, by default the trial's own.
        """
        return self.renderer(look=look).render(frame, passes)

    def renderer(
        self, width: int | None = None, height: int | None = None, look: str | None = None
    ) -> Renderer:
        """A renderer of the trial, by default in its own size and look; kept for the next call."""
        # Compiled code, which readers of numbers do not need to wait for.
        from physion.rendering.renderer import Renderer

        meta = self.metadata
        key = (width or meta.width, height or meta.height, look or meta.look)
        if key not in self._renderers:
            self._renderers[key] = Renderer(self.shown(key[2]), self.trajectory, *key[:2])
        return self._renderers[key]


def in_look(scene: Scene, look: str) -> Scene:
    """The scene in the colours of a look; `BadInputError` for an unknown one."""
    if look not in LOOKS:
        raise BadInputError(f"unknown look {look!r}; known: {', '.join(LOOKS)}")
    return with_role_colors(scene) if look == "redyellow" else scene


def _arrays(trajectory: Trajectory, ids: NDArray[Any], things: int) -> dict[str, NDArray[Any]]:
    """The arrays of a trial by the path of their field."""
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
