"""Reading of scenes from official files: bodies, sizes, masses, roles, pushes and camera.

What the files do not contain is filled in as in the original generator: the zone and ramps are
kinematic, distractors and occluders are scenery. An unknown model is replaced by a prop that fills
its bounding box. Everything that was left out or guessed is recorded in the notes.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.scenes.looks import RED, YELLOW, colors_are_similar, prop_look
from physion.scenes.sampling.build import FLOORS
from physion.scenes.scene import (
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
from physion.scenes.shapes.primitives import shapes
from physion.scenes.shapes.prop_names import FALLBACK, prop_for
from physion.scenes.tdw.commands import ROOMS as SCENE_ROOMS
from physion.scenes.tdw.commands import UNSET_MATERIAL, VANISHING_SCALE
from physion.seeds import generator
from physion.trials.official.axes import (
    from_official_camera,
    from_official_rotation,
    rotation_matrices,
    swap_angular_velocity,
    swap_axes,
)
from physion.trials.official.names import CLOTH_MODEL, RAMPS, ROOMS
from physion.trials.official.read_hdf5 import OfficialFile

Floats = NDArray[np.float64]

MAX_OBJECTS = 255
HEAVY = 500.0
"""Mass in kilograms from which a motionless object counts as held in index by the generator."""
_STILL = 1e-4
"""Change of position (m) or quaternion components below which an object has not moved."""
_ROOMS = {**SCENE_ROOMS, **{official: ours for ours, official in ROOMS.items()}, "empty": "empty"}
_TEXTURES = {"zone": "wood_ash", "other": "wood_cedar"}


@dataclass(frozen=True)
class ObjectMotion:
    """Poses and velocities (F, N, 3 or 4) of all objects, in axes of this package."""

    positions: Floats
    rotations: Floats
    velocities: Floats
    angular_velocities: Floats


@dataclass
class SceneReader:
    """Reader of the scene in one official file; ``notes`` collects what was guessed or left out."""

    file: OfficialFile
    name: str
    scenario: str
    notes: list[str] = field(default_factory=list)

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
            colors_are_similar(_vector(colors[self._role(role)]), color, 0.1)
            for role, color in wanted
        )

    def offsets(self) -> Floats:
        """Return the vectors (N, 3) from official pivots to those of the bodies, in body axes."""
        found = np.zeros((len(self.ids), 3))
        for index in self.bodies:
            if self.models[index] not in shapes:
                low, high = self._bounds(index)
                found[index] = ((low + high) / 2)[0], ((low + high) / 2)[1], low[2]
        return found

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
        look = Look(_vector(np.clip(color, 0, 1)), _TEXTURES["zone" if zone else "other"])
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
            scale=_vector(scale),
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
            look=Look(_vector(np.clip(color, 0, 1)), "cloth"),
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

    def _first_pose(self, index: int) -> tuple[Vec3, Quat]:
        rotation = self.motion.rotations[0, index]
        turned = rotation_matrices(rotation) @ self.offsets()[index]
        w, x, y, z = (float(value) for value in rotation / np.linalg.norm(rotation))
        return _vector(self.motion.positions[0, index] + turned), (w, x, y, z)

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

    def _roles(self) -> Roles:
        zone, target = self._role("zone_id"), self._role("target_id")
        probe = self._optional_role("probe_id")
        return Roles(
            agent=self.label(target),
            patient=self.label(zone),
            probe=None if probe is None else self.label(probe),
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
            point = _vector(at) if np.isfinite(at).all() else None
        frame = max(int(self.file.number("static/push_time", 0)), 0)
        return (Push(self.label(probe), _vector(force), point, frame),)

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


def _substitute_prop(model: str) -> str:
    """Return a prop for a library model by its name, by default `FALLBACK`."""
    for word in re.split(r"[^a-z]+", model.lower()):
        if word and (prop := prop_for(word)) != FALLBACK:
            return prop
    return FALLBACK


def _vector(values: Floats) -> Vec3:
    x, y, z = (float(value) for value in values)
    if not all(map(math.isfinite, (x, y, z))):
        raise BadInputError(f"{values} is not a position, size or colour")
    return (x, y, z)
