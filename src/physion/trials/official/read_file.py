"""Reading of official HDF5 files: the fields, then objects, scene and motion.

Files of different origin differ (docs/official-system.md, section 4): names may end with ``_cam0``,
frames may be counted from 0 or 1, labels may be missing, physics arrays may be shorter than the
list of objects, pictures may be PNG or JPEG. All of these are read. Links, arrays stored in other
files, unknown filters, types that are neither numbers nor text, and arrays that are too large
raise `BadInputError` with file and field.
"""

from __future__ import annotations

import math
import re
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import TracebackType

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay, QhullError

from physion.core.errors import BadInputError
from physion.core.seeds import generator
from physion.physics.trajectory import ENVIRONMENT, Contacts, Trajectory
from physion.scenes.looks import RED, YELLOW, colors_are_similar, prop_look
from physion.scenes.scene import (
    FLOORS,
    Body,
    Camera,
    Cloth,
    Ending,
    Look,
    Push,
    Quat,
    Roles,
    Scene,
    SurfaceMaterial,
    Vec3,
)
from physion.scenes.shapes.primitives import FALLBACK, prop_for, shape, shapes
from physion.scenes.tdw.commands import ROOMS as SCENE_ROOMS
from physion.scenes.tdw.commands import UNSET_MATERIAL, VANISHING_SCALE
from physion.trials.files import MAX_FRAMES, MAX_SIDE
from physion.trials.official.names import (
    CLOTH_DISTANCE,
    CLOTH_MODEL,
    RAMPS,
    ROOMS,
    decode_depth,
    decode_picture,
    from_official_camera,
    from_official_rotation,
    rotation_matrices,
    swap_angular_velocity,
    swap_axes,
)
from physion.trials.trial_file import GuardedHdf5, open_hdf5

MAX_BYTES = 2**27
"""Largest array that is read, in bytes of memory."""
MAX_TEXT = 2**20
_SUFFIXES = ("", "_cam0")
_FILTERS = {
    h5py.h5z.FILTER_DEFLATE,
    h5py.h5z.FILTER_SHUFFLE,
    h5py.h5z.FILTER_FLETCHER32,
    h5py.h5z.FILTER_LZF,
}


class OfficialFile(GuardedHdf5, AbstractContextManager["OfficialFile"]):
    """Reader of one official HDF5 file, for use in a ``with`` statement.

    Paths are paths in the file, such as ``static/mass`` or ``frames/0000/objects/positions``.
    """

    @classmethod
    def open(cls, path: Path) -> OfficialFile:
        """Open ``path``; `BadInputError` if it is not a regular HDF5 file."""
        where = f"official file {path}"
        if path.is_symlink() or not path.is_file():
            raise BadInputError(f"{where} is not a regular file")
        return cls(open_hdf5(path, where), where, filters=_FILTERS, max_chunk_bytes=MAX_BYTES)

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.close()

    def frames(self) -> list[str]:
        """Return the names of the frames in order, whether counted from 0 or 1."""
        names = [name for name in self.names("frames") if name.isdecimal()]
        if not 1 <= len(names) <= MAX_FRAMES:
            raise self.bad("frames", f"holds {len(names)} frames, not 1 to {MAX_FRAMES}")
        numbers = sorted(int(name) for name in names)
        if numbers != list(range(numbers[0], numbers[0] + len(numbers))):
            raise self.bad("frames", "has gaps in its numbers")
        return sorted(names, key=int)

    def names(self, path: str) -> list[str]:
        """Return the names in the group at ``path``; none if there is no group."""
        group = self.find(path)
        if not isinstance(group, h5py.Group):
            return []
        if self.guard(path, lambda: len(group)) > 100 * MAX_FRAMES:
            raise self.bad(path, "has too many entries")
        return list(self.guard(path, lambda: list(group)))

    def has(self, path: str) -> bool:
        """Return whether there is an array at ``path``, with or without a camera suffix."""
        return any(self.find(path + suffix) is not None for suffix in _SUFFIXES)

    def numbers(self, path: str, shape: tuple[int | None, ...]) -> NDArray[np.float64]:
        """Return the numbers, finite or not, at ``path``; None in ``shape`` allows any length."""
        dataset = self._dataset(path)
        if dataset.dtype.kind not in "fiub":
            raise self.bad(path, f"has type {dataset.dtype}, not numbers")
        found = dataset.shape
        fits = len(found) == len(shape) and all(
            wanted is None or length == wanted for length, wanted in zip(found, shape, strict=True)
        )
        if not fits:
            raise self.bad(path, f"has shape {found}, not {shape}")
        values = self.guard(path, lambda: dataset[()])
        return np.asarray(values, np.float64)

    def table(self, path: str, *row: int) -> NDArray[np.float64]:
        """Return the numbers at ``path`` reshaped to rows of shape ``row``."""
        dataset = self._dataset(path)
        values = self.numbers(path, tuple(None for _ in dataset.shape))
        if values.size % int(np.prod(row)):
            raise self.bad(path, f"has shape {dataset.shape}, not rows of {row}")
        return values.reshape(-1, *row)

    def number(self, path: str, default: float | None = None) -> float:
        """Return the number at ``path``, or ``default`` if it is absent and a default is given."""
        if default is not None and not self.has(path):
            return default
        dataset = self._dataset(path)
        values = self.numbers(path, tuple(None for _ in dataset.shape)).ravel()
        if values.size != 1 or not np.isfinite(values[0]):
            raise self.bad(path, f"is {values[:3]}, not one number")
        return float(values[0])

    def text(self, path: str, default: str | None = None) -> str:
        """Return the text at ``path``, or ``default`` if it is absent and a default is given."""
        if default is not None and not self.has(path):
            return default
        found = self.texts(path)
        if len(found) != 1:
            raise self.bad(path, f"holds {len(found)} texts, not one")
        return found[0]

    def texts(self, path: str) -> list[str]:
        """Return the texts of an array, or the one text of a scalar."""
        dataset = self._dataset(path)
        if h5py.check_string_dtype(dataset.dtype) is None:
            raise self.bad(path, f"has type {dataset.dtype}, not text")
        values = np.ravel(np.asarray(self.guard(path, lambda: dataset[()]), object))
        texts = [value if isinstance(value, bytes) else str(value).encode() for value in values]
        if sum(len(text) for text in texts) > 100 * MAX_TEXT:
            raise self.bad(path, "holds too much text")
        return [text.rstrip(b"\0").decode("utf-8", "replace") for text in texts]

    def data(self, path: str) -> bytes:
        """Return the bytes stored as an array at ``path``."""
        dataset = self._dataset(path)
        if dataset.dtype != np.uint8 or len(dataset.shape) != 1:
            raise self.bad(path, f"is {dataset.dtype} {dataset.shape}, not an array of bytes")
        return bytes(self.guard(path, lambda: dataset[()]))

    def picture(self, path: str) -> NDArray[np.uint8]:
        """Return the picture (H, W, 3) whose PNG or JPEG bytes are at ``path``."""
        data = np.frombuffer(self.data(path), np.uint8)
        try:
            return decode_picture(data)
        except BadInputError as error:
            raise self.bad(path, f"is {error}") from error

    def _dataset(self, path: str) -> h5py.Dataset:
        for suffix in _SUFFIXES:
            found = self.find(path + suffix)
            if found is not None:
                break
        else:
            raise self.bad(path, "is missing")
        if not isinstance(found, h5py.Dataset):
            raise self.bad(path, "is not an array")
        self.guard(path, lambda: self._check(path, found))
        return found

    def _check(self, path: str, dataset: h5py.Dataset) -> None:
        if dataset.shape is None:
            raise self.bad(path, "is empty")
        kind, itemsize = dataset.dtype.kind, dataset.dtype.itemsize
        if kind not in "fiubSO" or (kind == "O" and h5py.check_string_dtype(dataset.dtype) is None):
            raise self.bad(path, f"has type {dataset.dtype}")
        self.check_size(path, dataset.shape, itemsize, MAX_BYTES)
        self.check_storage(path, dataset)


# Reading of the objects in official files: ids, models, sizes, poses, roles and physics.
#
# Everything that was left out or guessed is recorded in the notes.

Floats = NDArray[np.float64]

MAX_OBJECTS = 255
_STILL = 1e-4
"""Change of position (m) or quaternion components below which an object has not moved."""


@dataclass(frozen=True)
class ObjectMotion:
    """Poses and velocities (F, N, 3 or 4) of all objects, in axes of this package."""

    positions: Floats
    rotations: Floats
    velocities: Floats
    angular_velocities: Floats


@dataclass
class ObjectReader:
    """Reader of the objects in one official file.

    Objects are numbered by their position in the file's list. ``notes`` collects what was guessed
    or left out.
    """

    file: OfficialFile
    notes: list[str] = field(default_factory=list, kw_only=True)

    @cached_property
    def frames(self) -> list[str]:
        """Paths of the frames in the file."""
        return [f"frames/{name}" for name in self.file.frames()]

    @cached_property
    def ids(self) -> list[int]:
        """Ids of the objects."""
        found = self.file.numbers("static/object_ids", (None,))
        ids = [int(id_) for id_ in found] if np.isfinite(found).all() else []
        if not 2 <= len(ids) <= MAX_OBJECTS or len(set(ids)) != len(ids):
            raise self.file.bad("static/object_ids", "does not list 2 to 255 different objects")
        return ids

    @cached_property
    def models(self) -> list[str]:
        """Model names of the objects."""
        found = self.file.texts("static/model_names")
        if len(found) != len(self.ids):
            raise self.file.bad(
                "static/model_names", f"has {len(found)} names for {len(self.ids)} objects"
            )
        return found

    @cached_property
    def scales(self) -> Floats:
        """Scale factors (N, 3) along the axes of each object, in axes of this package."""
        return swap_axes(self._static("scale", 3, 1.0))

    @cached_property
    def motion(self) -> ObjectMotion:
        """Poses and velocities of all objects in all frames."""
        count = len(self.ids)

        def stack(name: str, width: int) -> Floats:
            path = "{}/objects/" + name
            rows = [self.file.numbers(path.format(at), (count, width)) for at in self.frames]
            return np.stack(rows)

        return ObjectMotion(
            swap_axes(stack("positions", 3)),
            from_official_rotation(stack("rotations", 4)),
            swap_axes(stack("velocities", 3)),
            swap_angular_velocity(stack("angular_velocities", 3)),
        )

    @cached_property
    def kept(self) -> list[int]:
        """Indices of the objects that have a size, a mass, and a pose in every frame."""
        motion, found = self.motion, []
        for index, id_ in enumerate(self.ids):
            posed = all(
                np.isfinite(values[:, index]).all()
                for values in (
                    motion.positions,
                    motion.rotations,
                    motion.velocities,
                    motion.angular_velocities,
                )
            )
            turned = posed and bool(
                (np.linalg.norm(motion.rotations[:, index], axis=1) > 0.5).all()
            )
            sized = float(self.scales[index].min()) > VANISHING_SCALE
            if turned and sized and self._physics("mass", 1.0)[index] > 0:
                found.append(index)
            else:
                self.notes.append(f"object {id_} has no pose, size or mass and is left out")
        return found

    @cached_property
    def bodies(self) -> list[int]:
        """Indices of the rigid bodies among the objects."""
        return [index for index in self.kept if self.models[index] != CLOTH_MODEL]

    @cached_property
    def cloths(self) -> list[int]:
        """Indices of the cloths among the objects."""
        return [index for index in self.kept if self.models[index] == CLOTH_MODEL]

    def label(self, index: int) -> str:
        """Return the name of the body or cloth that is made from an object."""
        return f"{self.models[index]}_{self.ids[index]}"

    def offsets(self) -> Floats:
        """Return the vectors (N, 3) from official to our pivots, in body axes."""
        found = np.zeros((len(self.ids), 3))
        for index in self.bodies:
            if self.models[index] not in shapes:
                low, high = self._bounds(index)
                found[index] = ((low + high) / 2)[0], ((low + high) / 2)[1], low[2]
        return found

    def _first_pose(self, index: int) -> tuple[Vec3, Quat]:
        rotation = self.motion.rotations[0, index]
        turned = rotation_matrices(rotation) @ self.offsets()[index]
        w, x, y, z = (float(value) for value in rotation / np.linalg.norm(rotation))
        return vector(self.motion.positions[0, index] + turned), (w, x, y, z)

    def _is_scenery(self, index: int) -> bool:
        """Return whether an object is scenery: listed so or without physics, and motionless."""
        roles = {self._role(role) for role in ("zone_id", "target_id")}
        if index in roles or index == self._optional_role("probe_id"):
            return False
        named = self.models[index] in self._scenery_models
        return (named or index >= self._physics_count) and self._never_moves(index)

    @cached_property
    def _scenery_models(self) -> set[str]:
        paths = ("static/distractors", "static/occluders")
        return {name for path in paths if self.file.has(path) for name in self.file.texts(path)}

    def _never_moves(self, index: int) -> bool:
        motion = self.motion
        return all(
            float(np.abs(values[:, index] - values[0, index]).max()) < _STILL
            for values in (motion.positions, motion.rotations)
        )

    def _role(self, key: str) -> int:
        """Return the index of the object with a role that every trial has."""
        found = self._optional_role(key)
        if found is None:
            raise self.file.bad(f"static/{key}", "does not name an existing object")
        return found

    def _optional_role(self, key: str) -> int | None:
        if not self.file.has(f"static/{key}"):
            return None
        id_ = int(self.file.number(f"static/{key}"))
        index = self.ids.index(id_) if id_ in self.ids else None
        return index if index in self.kept else None

    @property
    def _physics_count(self) -> int:
        """Number of objects, from the first on, that the physics arrays cover."""
        if not self.file.has("static/mass"):
            return len(self.ids)
        return len(self.file.numbers("static/mass", (None,)))

    def _physics(self, name: str, default: float) -> Floats:
        return self._static(name, 1, default)[:, 0]

    def _static(self, name: str, width: int, default: float) -> Floats:
        """Return the rows (N, width) of a static array; ``default`` where it has none."""
        found = np.full((len(self.ids), width), default)
        path = f"static/{name}"
        if not self.file.has(path):
            return found
        rows = self.file.table(path, width)
        if len(rows) > len(self.ids):
            raise self.file.bad(path, f"has {len(rows)} rows for {len(self.ids)} objects")
        found[: len(rows)] = np.where(np.isfinite(rows), rows, default)
        return found

    def _bounds(self, index: int) -> tuple[Floats, Floats]:
        """Return the corners of the scaled bounding box of an object of unknown shape."""
        path = f"static/mesh/vertices_{index}"
        vertices = self.file.table(path, 3) if self.file.has(path) else np.zeros((0, 3))
        if len(vertices) and np.isfinite(vertices).all():
            points = swap_axes(vertices) * self.scales[index]
        else:
            points = self._box_corners(index)
        low, high = points.min(axis=0), points.max(axis=0)
        # Flat objects get a thickness of 1 mm.
        return low, np.maximum(high, low + 1e-3)

    def _box_corners(self, index: int) -> Floats:
        """Return face centres of the bounding box in frame 0 about the pivot, or a default."""
        sides = ("left", "right", "front", "back", "top", "bottom")
        paths = [f"{self.frames[0]}/objects/{side}" for side in sides]
        if all(self.file.has(path) for path in paths):
            count = len(self.ids)
            faces = np.stack([self.file.numbers(path, (count, 3))[index] for path in paths])
            away = swap_axes(faces) - self.motion.positions[0, index]
            if np.isfinite(away).all() and np.ptp(away, axis=0).max() < 100.0:
                return np.asarray(away @ rotation_matrices(self.motion.rotations[0, index]))
        self.notes.append(f"no bounds are known for {self.models[index]!r}; 0.5 m is assumed")
        return np.array([[-0.25, -0.25, 0.0], [0.25, 0.25, 0.5]])


def vector(values: Floats) -> Vec3:
    """Return three finite numbers as a tuple; `BadInputError` for others."""
    x, y, z = (float(value) for value in values)
    if not all(map(math.isfinite, (x, y, z))):
        raise BadInputError(f"{values} is not a position, size or colour")
    return (x, y, z)


# Conversion of official files to scenes: bodies, cloths, roles, pushes and camera.
#
# What the files do not contain is filled in as in the original generator: the zone and ramps are
# kinematic, distractors and occluders are scenery. An unknown model is replaced by a prop that
# fills its bounding box. Everything that was left out or guessed is recorded in the notes.

HEAVY = 500.0
"""Mass in kilograms from which a motionless object counts as held in place by the generator."""
_ROOMS = {**SCENE_ROOMS, **{official: ours for ours, official in ROOMS.items()}, "empty": "empty"}
_TEXTURES = {"zone": "wood_ash", "other": "wood_cedar"}


@dataclass
class SceneReader(ObjectReader):
    """Reader of the scene in one official file, called ``name``, of a scenario."""

    name: str
    scenario: str

    def scene(self, resolutions: dict[int, int]) -> Scene:
        """Return the scene; ``resolutions`` has the vertices per side of each cloth, by index."""
        camera = self._camera()
        room = _ROOMS.get(self.file.text("static/room", "").strip())
        if room is None:
            self.notes.append("the room is not modelled; it is replaced by the empty room")
        bodies = tuple(self._body(index) for index in self.bodies)
        return Scene(
            name=self.name,
            scenario=self.scenario,
            bodies=bodies,
            cloths=tuple(self._cloth(index, resolutions[index]) for index in self.cloths),
            roles=self._roles(),
            pushes=self._pushes(),
            camera=camera,
            room=room or "empty",
            floor=FLOORS.get(room or "empty", 0.0),
            ending=Ending(min(151, len(self.frames)), len(self.frames)),
            parameters={
                "source": "official HDF5 file",
                "git_commit": self.file.text("static/git_commit", ""),
                "trial_seed": int(self.file.number("static/trial_seed", -1)),
            },
        )

    def redyellow(self) -> bool:
        """Return whether the target is red and the zone yellow."""
        colors = self._static("color", 3, 0.8)
        wanted = (("target_id", RED), ("zone_id", YELLOW))
        return all(
            colors_are_similar(vector(colors[self._role(role)]), color, 0.1)
            for role, color in wanted
        )

    def _body(self, index: int) -> Body:
        model, scale = self.models[index], self.scales[index]
        zone = index == self._role("zone_id")
        if model in shapes:
            shape = model
        else:
            shape, (low, high) = _substitute_prop(model), self._bounds(index)
            scale = high - low
            self.notes.append(f"no shape is known for {model!r}; it is replaced by {shape}")
        color = self._static("color", 3, 0.8)[index]
        look = Look(vector(np.clip(color, 0, 1)), _TEXTURES["zone" if zone else "other"])
        scenery = self._is_scenery(index)
        if scenery and shape.startswith("prop:"):
            rng = generator("library model", model)
            look = prop_look(rng, shape)
        mass = float(self._physics("mass", 1.0)[index])
        still = self._never_moves(index)
        # Solids of Flex rest on the floor and do not move once settled.
        held = zone or model in RAMPS or mass >= HEAVY or bool(self.cloths)
        position, rotation = self._first_pose(index)
        return Body(
            name=self.label(index),
            shape=shape,
            position=position,
            rotation=rotation,
            scale=vector(scale),
            mass=mass,
            contact=SurfaceMaterial(
                float(self._physics("static_friction", UNSET_MATERIAL.static_friction)[index]),
                float(self._physics("dynamic_friction", UNSET_MATERIAL.dynamic_friction)[index]),
                float(self._physics("bounciness", UNSET_MATERIAL.restitution)[index]),
            ),
            kinematic=(held and still) or scenery,
            scenery=scenery,
            look=look,
        )

    def _cloth(self, index: int, resolution: int) -> Cloth:
        position, rotation = self._first_pose(index)
        scale = self.scales[index]
        color = self._static("color", 3, 0.8)[index]
        return Cloth(
            name=self.label(index),
            position=position,
            rotation=rotation,
            size=(2 * float(scale[0]), 2 * float(scale[1]), 0.0),
            mass=float(self._physics("mass", 0.5)[index]),
            resolution=resolution,
            **self._stiffness(index),
            look=Look(vector(np.clip(color, 0, 1)), "cloth"),
        )

    def _stiffness(self, index: int) -> dict[str, float]:
        """Return stretch, bend and tether of a cloth, as far as the file has them."""
        group = "static/cloth_actors"
        if not self.file.has(f"{group}/object_id"):
            return {}
        ids = self.file.numbers(f"{group}/object_id", (None,)).tolist()
        found = {}
        for name in ("stretch", "bend", "tether"):
            path = f"{group}/{name}_stiffness"
            if self.ids[index] in ids and self.file.has(path):
                value = self.file.numbers(path, (len(ids),))[ids.index(self.ids[index])]
                if not 0 <= value <= 1:
                    raise self.file.bad(path, f"holds {value}, which is not a stiffness in 0..1")
                found[name] = float(value)
        return found

    def _roles(self) -> Roles:
        zone, target = self._role("zone_id"), self._role("target_id")
        probe = self._optional_role("probe_id")
        return Roles(
            agent=self.label(target),
            patient=self.label(zone),
            probe=None if probe is None else self.label(probe),
        )

    def _pushes(self) -> tuple[Push, ...]:
        probe = self._optional_role("probe_id")
        if probe is None or not self.file.has("static/push_force"):
            return ()
        force = swap_axes(self.file.numbers("static/push_force", (3,)))
        if not (np.isfinite(force).all() and force.any()) or probe not in self.bodies:
            return ()
        point = None
        if self.file.has("static/push_position"):
            at = swap_axes(self.file.numbers("static/push_position", (3,)))
            point = vector(at) if np.isfinite(at).all() else None
        frame = max(int(self.file.number("static/push_time", 0)), 0)
        return (Push(self.label(probe), vector(force), point, frame),)

    def _camera(self) -> Camera:
        first, last = (
            [
                self.file.numbers(f"{frame}/camera_matrices/{name}", (16,)).reshape(4, 4)
                for name in ("camera_matrix", "projection_matrix")
            ]
            for frame in (self.frames[0], self.frames[-1])
        )
        if not np.allclose(first[0], last[0], atol=1e-4):
            self.notes.append("the camera moves; it is kept as in the first frame")
        middle = self.motion.positions[0, self.kept].mean(axis=0)
        try:
            camera, upright = from_official_camera(first[0], first[1], middle)
        except BadInputError as error:
            raise self.file.bad(f"{self.frames[0]}/camera_matrices", f"is bad: {error}") from error
        if not upright:
            self.notes.append("the camera has roll, which is removed")
        return camera


def _substitute_prop(model: str) -> str:
    """Return a prop for a library model by its name, by default `FALLBACK`."""
    for word in re.split(r"[^a-z]+", model.lower()):
        if word and (prop := prop_for(word)) != FALLBACK:
            return prop
    return FALLBACK


# Motion of an official file (poses, contacts, cloth), read as a `Trajectory`.
#
# In official files the number of contact points differs from the number of pairs
# (docs/official-system.md, section 4.2). If there are as many points as pairs that touch, they are
# assigned in order, as this package exports them; otherwise each pair gets the point that is
# nearest to both of its bounding boxes.

MAX_RESOLUTION = 101
_NEAR = 50.0
"""Depth in metres from which pixels say nothing about the rows of a picture."""
_DEPTH_ERROR = 0.1
"""Median relative error above which a picture is not the depth of the scene."""
_UNKNOWN = np.full(3, np.nan)


@dataclass
class MotionReader:
    """Reader of the scene and the trajectory of one official file."""

    reader: SceneReader

    @cached_property
    def scene(self) -> Scene:
        """Scene of the trial."""
        return self.reader.scene({index: self._resolution(index) for index in self.reader.cloths})

    @cached_property
    def labelled_contact(self) -> NDArray[np.bool_] | None:
        """Whether target and zone touch in each frame (F,) by the file's labels; None without."""
        name = "labels/target_contacting_zone"
        paths = [f"{frame}/{name}" for frame in self.reader.frames]
        if not all(self.reader.file.has(path) for path in paths):
            return None
        return np.array([self.reader.file.number(path) != 0 for path in paths])

    def trajectory(self) -> Trajectory:
        """Return the motion, with the pivots of the bodies of this package."""
        reader, motion = self.reader, self.reader.motion
        matrices = rotation_matrices(motion.rotations[:, reader.bodies])
        offsets = reader.offsets()[reader.bodies]
        positions = motion.positions[:, reader.bodies] + np.einsum(
            "fnij,nj->fni", matrices, offsets
        )
        rotations = motion.rotations[:, reader.bodies]
        rotations = rotations / np.linalg.norm(rotations, axis=-1, keepdims=True)
        complete = [f"{frame}/labels/trial_complete" for frame in reader.frames]
        commit = reader.file.text("static/git_commit", "")
        return Trajectory(
            positions=positions.astype(np.float32),
            rotations=rotations.astype(np.float32),
            velocities=motion.velocities[:, reader.bodies].astype(np.float32),
            angular_velocities=motion.angular_velocities[:, reader.bodies].astype(np.float32),
            cloth_vertices=self._cloth_vertices(),
            cloth_distance=self._cloth_distance(),
            contacts=self._contacts(positions, matrices),
            completed=any(reader.file.number(path, 0) != 0 for path in complete),
            engine=f"imported: {commit if commit.startswith('physion ') else 'TDW'}",
        )

    def depth(self, trajectory: Trajectory, frame: int) -> Floats | None:
        """Return the depth (H, W) in metres that a frame stores, top row first.

        The official writer stores the top row first; files of earlier versions of this package, and
        other programs that store TDW's raw pass, the bottom row. Which it is follows from a
        comparison with what the meshes and the camera of the file show, so no version is asked.
        None, with a note, if neither fits (`_depth` of the released test files holds colours).
        """
        # Imported late: loading the compiled renderer takes time.
        from physion.rendering.renderer import Renderer

        path = f"{self.reader.frames[frame]}/images/_depth"
        stored = self._stored_depth(path)
        if stored is None or max(stored.shape) > MAX_SIDE:
            self.reader.notes.append("its _depth is no depth and is not read")
            return None
        renderer = Renderer(self.scene, trajectory, stored.shape[1], stored.shape[0])
        drawn = renderer.render(frame, ("depth",)).depth
        assert drawn is not None, "the renderer left out depth"
        near = drawn < _NEAR
        upright, turned = (
            float(np.median(np.abs(rows[near] / drawn[near] - 1))) if near.any() else np.inf
            for rows in (stored, stored[::-1])
        )
        if min(upright, turned) > _DEPTH_ERROR:
            self.reader.notes.append("its _depth does not show its scene and is not read")
            return None
        if turned < upright:
            self.reader.notes.append("its _depth has the bottom row first")
            return stored[::-1]
        return stored

    def _stored_depth(self, path: str) -> Floats | None:
        """Return depth (H, W) in metres as stored; None if the array is not a depth."""
        try:
            return decode_depth(self.reader.file.numbers(path, (None, None, 3)))
        except BadInputError:
            try:
                # Version 1.5 stores metres.
                return self.reader.file.numbers(path, (None, None))
            except BadInputError:
                return None

    def _contacts(self, positions: Floats, matrices: Floats) -> Contacts:
        """Return one contact per pair and frame.

        If the labels have a contact of target and zone that is not in the contact records, it is
        added with an unknown point (NaN).
        """
        scene, reader = self.scene, self.reader
        names = scene.names()
        indices = {reader.ids[p]: names.index(reader.label(p)) for p in reader.kept}
        bounds = [shape(body.shape).bounds * np.asarray(body.scale) for body in scene.bodies]
        roles = scene.index(scene.roles.agent), scene.index(scene.roles.patient)
        asked = min(roles), max(roles)
        labelled_contact, rows = self.labelled_contact, []
        for frame in range(len(reader.frames)):
            boxes = _Boxes(positions[frame], matrices[frame], bounds)
            found = self._pairs(frame, indices, boxes)
            if (
                labelled_contact is not None
                and labelled_contact[frame]
                and not scene.cloths
                and asked not in found
            ):
                found[asked] = (_UNKNOWN, _UNKNOWN)
            rows += [(frame, *pair, *found[pair]) for pair in sorted(found)]
        count = len(rows)
        return Contacts(
            np.array([row[0] for row in rows], np.int32).reshape(count),
            np.array([row[1:3] for row in rows], np.int32).reshape(count, 2),
            np.array([row[3] for row in rows], np.float32).reshape(count, 3),
            np.array([row[4] for row in rows], np.float32).reshape(count, 3),
            # Official files have no impulses.
            np.full(count, np.nan, np.float32),
        )

    def _pairs(
        self, frame: int, indices: dict[int, int], boxes: _Boxes
    ) -> dict[tuple[int, int], tuple[Floats, Floats]]:
        """Return point and normal by pair of bodies in one frame."""
        file, at = self.reader.file, self.reader.frames[frame]
        found: dict[tuple[int, int], tuple[Floats, Floats]] = {}
        if file.has(f"{at}/collisions/object_ids"):
            pairs = file.table(f"{at}/collisions/object_ids", 2)
            contacts = file.table(f"{at}/collisions/contacts", 2, 3)
            states = file.texts(f"{at}/collisions/states") if len(pairs) else []
            if len(states) != len(pairs):
                raise file.bad(
                    f"{at}/collisions/states", f"does not have the {len(pairs)} rows of ids"
                )
            touching = [row for row, state in enumerate(states) if not state.startswith("ex")]
            # Exports of this package have one point for each pair that touches, earlier ones also
            # for pairs that separate.
            with_point = range(len(pairs)) if len(contacts) == len(pairs) else touching
            for row in touching:
                a, b = (indices.get(int(id_)) if np.isfinite(id_) else None for id_ in pairs[row])
                if a is None or b is None or a == b:
                    continue
                chosen = (
                    with_point.index(row)
                    if len(contacts) == len(with_point)
                    else boxes.nearest(contacts, (a, b))
                )
                if chosen is not None:
                    normal, point = swap_axes(contacts[chosen])
                    # Official normals point from the second body to the first.
                    key, sign = ((a, b), -1.0) if a < b else ((b, a), 1.0)
                    found.setdefault(key, (point, sign * normal))
        if file.has(f"{at}/env_collisions/object_ids"):
            ids = file.table(f"{at}/env_collisions/object_ids", 1)[:, 0]
            contacts = file.table(f"{at}/env_collisions/contacts", 2, 3)
            for row, id_ in enumerate(ids):
                body = indices.get(int(id_)) if np.isfinite(id_) else None
                if body is None:
                    continue
                chosen = row if len(contacts) == len(ids) else boxes.nearest(contacts, (body,))
                if chosen is not None:
                    normal, point = swap_axes(contacts[chosen])
                    found.setdefault((ENVIRONMENT, body), (point, normal))
        return found

    def _cloth_distance(self) -> NDArray[np.float32]:
        name = "labels/minimum_distance_target_to_zone"
        gaps = [
            self.reader.file.numbers(f"{frame}/{name}", ())
            if self.reader.file.has(f"{frame}/{name}")
            else np.nan
            for frame in self.reader.frames
        ]
        return (np.array(gaps, np.float64) - CLOTH_DISTANCE).astype(np.float32)

    def _cloth_vertices(self) -> NDArray[np.float32]:
        """Return the vertices (F, V, 3) of all sheets, interpolated between particles."""
        frames = len(self.reader.frames)
        parts = [np.zeros((frames, 0, 3), np.float32)]
        for index in self.reader.cloths:
            corners, weights = self._weights(index)
            for_all = [
                np.einsum("vk,vkj->vj", weights, self.particles(index, frame)[corners])
                for frame in range(frames)
            ]
            parts.append(np.stack(for_all).astype(np.float32))
        return np.concatenate(parts, axis=1)

    def particles(self, index: int, frame: int) -> Floats:
        """Return the particle positions (P, 3) of a cloth in a frame, in axes of this package."""
        path = f"{self.reader.frames[frame]}/particles/{self.reader.ids[index]}"
        found = swap_axes(self.reader.file.numbers(path, (None, 4))[:, :3])
        if len(found) < 4 or not np.isfinite(found).all():
            raise self.reader.file.bad(path, "is not a cloth of at least 4 finite particles")
        return found

    def _resolution(self, index: int) -> int:
        """Return the vertices per side of a sheet with about as many vertices as particles."""
        count = len(self.particles(index, 0))
        return int(np.clip(round(np.sqrt(count)), 2, MAX_RESOLUTION))

    def _weights(self, index: int) -> tuple[NDArray[np.int64], Floats]:
        """Return three particles (V, 3) and their weights (V, 3) for each vertex of the sheet.

        In frame 0 the cloth is flat, so every vertex lies in a triangle of a triangulation of the
        particles, whatever their order and number. Its barycentric coordinates are the weights.
        """
        reader = self.reader
        matrix = rotation_matrices(reader.motion.rotations[0, index])
        flat = (self.particles(index, 0) - reader.motion.positions[0, index]) @ matrix
        side = self._resolution(index)
        along_x, along_y = (np.linspace(-s, s, side) for s in reader.scales[index][:2])
        grid = np.stack(np.meshgrid(along_x, along_y, indexing="ij"), axis=-1).reshape(-1, 2)
        try:
            mesh = Delaunay(flat[:, :2])
        except (QhullError, ValueError) as error:
            path = f"{reader.frames[0]}/particles/{reader.ids[index]}"
            raise reader.file.bad(path, "does not begin as a flat sheet") from error
        # By rounding, vertices on the rim may lie outside: they follow the nearest particle.
        inside = mesh.find_simplex(grid, tol=1e-6)
        nearest = np.linalg.norm(flat[:, None, :2] - grid[inside < 0], axis=-1).argmin(axis=0)
        corners = mesh.simplices[np.maximum(inside, 0)].astype(np.int64)
        frame = mesh.transform[np.maximum(inside, 0)]
        first = np.einsum("vij,vj->vi", frame[:, :2], grid - frame[:, 2])
        weights = np.clip(np.column_stack([first, 1 - first.sum(axis=1)]), 0, 1)
        weights /= weights.sum(axis=1, keepdims=True)
        corners[inside < 0] = nearest[:, None]
        weights[inside < 0] = (1.0, 0.0, 0.0)
        return corners, weights


@dataclass(frozen=True)
class _Boxes:
    """Bounding boxes of all bodies in one frame: pivots, rotation matrices, corners (2, 3)."""

    positions: Floats
    matrices: Floats
    bounds: list[Floats]

    def nearest(self, contacts: Floats, bodies: tuple[int, ...]) -> int | None:
        """Return the row of the official contacts whose point is nearest to ``bodies``.

        ``contacts`` has shape (n, 2, 3): normal and point.
        """
        if not len(contacts):
            return None
        points = swap_axes(contacts[:, 1])
        away = np.zeros(len(points))
        for body in bodies:
            if body < len(self.bounds):
                local = (points - self.positions[body]) @ self.matrices[body]
                low, high = self.bounds[body]
                away += np.linalg.norm(local - np.clip(local, low, high), axis=1)
        return int(np.nan_to_num(away, nan=np.inf).argmin())
