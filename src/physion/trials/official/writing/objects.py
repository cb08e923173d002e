"""Objects of a scene as listed in the official files: order, ids, names, sizes, meshes.

Object ids count from 1. The zone comes first, then a ramp, the target and the probe, because
official readers find target and zone by their position; then all others in the order of the scene.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from physion.physics.cloth.sheet import sheet_triangles, sheet_vertices
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import Body, Cloth, Scene
from physion.scenes.shapes.primitives import shape
from physion.trials.official.axes import rotation_matrices, swap_axes
from physion.trials.official.names import CLOTH_MODEL, RAMPS

Floats = NDArray[np.float64]

_SIDES = {
    "front": (0.0, 1.0, 0.0),
    "back": (0.0, -1.0, 0.0),
    "left": (-1.0, 0.0, 0.0),
    "right": (1.0, 0.0, 0.0),
    "top": (0.0, 0.0, 1.0),
    "bottom": (0.0, 0.0, -1.0),
    "center": (0.0, 0.0, 0.0),
}
"""Face centres of a box relative to its centre, in half sizes, along the object's axes."""


@dataclass(frozen=True)
class OfficialObjects:
    """Objects of a trial in the official order."""

    scene: Scene
    trajectory: Trajectory

    @cached_property
    def order(self) -> list[int]:
        """Index of each object in `Scene.names`."""
        scene = self.scene
        roles = scene.roles
        first = [roles.patient]
        first += [body.name for body in scene.bodies if body.shape in RAMPS][:1]
        first += [roles.agent, *([roles.probe] if roles.probe else [])]
        names = [*first, *scene.names()]
        return [scene.index(name) for name in dict.fromkeys(names)]

    @cached_property
    def ids(self) -> dict[str, int]:
        """Object ids, from 1, by name."""
        names = self.scene.names()
        return {names[index]: id_ for id_, index in enumerate(self.order, start=1)}

    def __len__(self) -> int:
        return len(self.order)

    @cached_property
    def things(self) -> list[Body | Cloth]:
        """Body or cloth of each object."""
        everything: list[Body | Cloth] = [*self.scene.bodies, *self.scene.cloths]
        return [everything[index] for index in self.order]

    @property
    def models(self) -> list[str]:
        """Model name of each object."""
        return [model_name(thing) for thing in self.things]

    @cached_property
    def scales(self) -> Floats:
        """Scale factors (N, 3) along the axes of each object, in axes of this package."""
        return np.array([_scale(thing) for thing in self.things])

    @cached_property
    def poses(self) -> tuple[Floats, Floats]:
        """Positions (F, N, 3) and rotations (F, N, 4); a cloth's position is that of its centre."""
        t = self.trajectory
        frames, bodies = t.positions.shape[:2]
        count = bodies + len(self.scene.cloths)
        positions, rotations = np.zeros((frames, count, 3)), np.zeros((frames, count, 4))
        positions[:, :bodies], rotations[:, :bodies] = t.positions, t.rotations
        for index, cloth in enumerate(self.scene.cloths, start=bodies):
            positions[:, index] = self.cloth_vertices(index).mean(axis=1)
            rotations[:, index] = cloth.rotation
        return positions[:, self.order], rotations[:, self.order]

    @cached_property
    def motions(self) -> tuple[Floats, Floats]:
        """Linear and angular velocities (F, N, 3); zero for cloths, for which none are stored."""
        t = self.trajectory
        pad = ((0, 0), (0, len(self.scene.cloths)), (0, 0))
        return (
            np.pad(t.velocities.astype(np.float64), pad)[:, self.order],
            np.pad(t.angular_velocities.astype(np.float64), pad)[:, self.order],
        )

    def cloth_vertices(self, index: int) -> Floats:
        """Return the vertices (F, V, 3) of the cloth with this index in `Scene.names`."""
        sizes = [cloth.resolution**2 for cloth in self.scene.cloths]
        cloth = index - len(self.scene.bodies)
        start = sum(sizes[:cloth])
        vertices = self.trajectory.cloth_vertices[:, start : start + sizes[cloth]]
        return np.asarray(vertices, np.float64)

    def mesh(self, index: int) -> tuple[Floats, NDArray[np.int32]]:
        """Return vertices (V, 3) and triangles (T, 3) of an object for the official files.

        Vertices are in the object's frame, official axes, at unit scale. Triangles are clockwise
        as seen from outside, as in Unity, so the cross product of edges points outwards.
        """
        thing = self.things[index]
        if isinstance(thing, Cloth):
            flat = Cloth(thing.name, (0.0, 0.0, 0.0), resolution=thing.resolution)
            vertices, faces = sheet_vertices(flat), sheet_triangles(thing.resolution)
        else:
            mesh = shape(thing.shape).mesh
            vertices, faces = mesh.vertices, mesh.faces
        return swap_axes(vertices), faces[:, ::-1]

    @cached_property
    def boxes(self) -> dict[str, Floats]:
        """Face centres and centre (F, N, 3) of the bounding boxes of all objects, by side."""
        positions, rotations = self.poses
        matrices = rotation_matrices(rotations)
        low, high = np.moveaxis(self._bounds, 1, 0) * self.scales
        found = {}
        for side, away in _SIDES.items():
            local = (low + high) / 2 + np.array(away) * (high - low) / 2
            found[side] = positions + (matrices * local[:, None]).sum(axis=-1)
        for index, thing in enumerate(self.things):
            if isinstance(thing, Cloth):
                points = self.cloth_vertices(self.order[index])
                low_, high_ = points.min(axis=1), points.max(axis=1)
                for side, away in _SIDES.items():
                    middle = (low_ + high_) / 2
                    found[side][:, index] = middle + np.array(away) * (high_ - low_) / 2
        return found

    def official_ids(self, ids: NDArray[np.int16]) -> NDArray[np.int16]:
        """Return official object ids by pixel, 0 the room, of ``ids`` (H, W) of the renderer."""
        table = np.zeros(len(self) + 1, np.int16)
        table[np.array(self.order) + 1] = np.arange(1, len(self) + 1)
        return np.asarray(table[ids])

    @cached_property
    def _bounds(self) -> Floats:
        return np.stack(
            [
                np.zeros((2, 3)) if isinstance(thing, Cloth) else shape(thing.shape).bounds
                for thing in self.things
            ]
        )

    @cached_property
    def scenery(self) -> dict[str, list[str]]:
        """Names of the scenery: ``occluders`` in front of the scene, ``distractors`` behind it."""
        eye, middle = np.array(self.scene.camera.position), np.array(self.scene.camera.target)
        found: dict[str, list[str]] = {"distractors": [], "occluders": []}
        for body in self.scene.bodies:
            if not body.scenery:
                continue
            before = float((np.array(body.position) - middle) @ (eye - middle)) > 0
            if body.name.startswith(("occluder", "distractor")):
                before = body.name.startswith("occluder")
            found["occluders" if before else "distractors"].append(body.name)
        return found

    @cached_property
    def middle(self) -> list[Body]:
        """Bodies that can move and have no role: dominoes, blocks, links."""
        roles = self.scene.roles
        taken = {roles.agent, roles.patient, roles.probe}
        return [
            body
            for body in self.scene.bodies
            if body.name not in taken and not body.scenery and not body.kinematic
        ]


def model_name(thing: Body | Cloth) -> str:
    """Return the official name of a model; props keep the names of this package."""
    return CLOTH_MODEL if isinstance(thing, Cloth) else thing.shape


def _scale(thing: Body | Cloth) -> tuple[float, float, float]:
    if isinstance(thing, Body):
        return thing.scale
    # The official square of cloth is 2 m a side.
    return (thing.size[0] / 2, thing.size[1] / 2, 1.0)
