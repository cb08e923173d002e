"""Reading of the objects in official files: ids, models, sizes, poses, roles and physics.

Everything that was left out or guessed is recorded in the notes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.scenes.scene import Quat, Vec3
from physion.scenes.shapes.primitives import shapes
from physion.scenes.tdw.commands import VANISHING_SCALE
from physion.trials.official.axes import (
    from_official_rotation,
    rotation_matrices,
    swap_angular_velocity,
    swap_axes,
)
from physion.trials.official.names import CLOTH_MODEL
from physion.trials.official.read_hdf5 import OfficialFile

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
        """Return the vectors (N, 3) from official pivots to those of the bodies, in body axes."""
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
