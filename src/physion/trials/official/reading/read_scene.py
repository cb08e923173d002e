"""Conversion of official files to scenes: bodies, cloths, roles, pushes and camera.

What the files do not contain is filled in as in the original generator: the zone and ramps are
kinematic, distractors and occluders are scenery. An unknown model is replaced by a prop that fills
its bounding box. Everything that was left out or guessed is recorded in the notes.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

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
    Roles,
    Scene,
    SurfaceMaterial,
)
from physion.scenes.shapes.primitives import shapes
from physion.scenes.shapes.prop_names import FALLBACK, prop_for
from physion.scenes.tdw.commands import ROOMS as SCENE_ROOMS
from physion.scenes.tdw.commands import UNSET_MATERIAL
from physion.seeds import generator
from physion.trials.official.axes import from_official_camera, swap_axes
from physion.trials.official.names import RAMPS, ROOMS
from physion.trials.official.reading.read_objects import ObjectReader, vector

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
