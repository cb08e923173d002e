"""Objects in official files: order, ids, sizes, meshes, cloth, contacts and particles.

Object ids count from 1. The zone comes first, then a ramp, the target and the probe, because
official readers find target and zone by their position; then all others in the order of the scene,
scenery last, because arrays of masses and frictions end before it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
from h5py import h5d, h5g, h5o, h5p, h5s, h5t
from numpy.typing import NDArray

from physion.physics.cloth.simulate import ClothSettings
from physion.physics.cloth.springs import sheet_triangles, sheet_vertices
from physion.physics.particles import particles_over_time
from physion.physics.trajectory import ENVIRONMENT, Trajectory
from physion.scenes.scene import FRAME_TIME, Body, Cloth, Scene
from physion.scenes.shapes.primitives import shape
from physion.trials.official.names import CLOTH_MODEL, RAMPS, rotation_matrices, swap_axes

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
        scenery = [body.name for body in scene.bodies if body.scenery]
        others = [name for name in scene.names() if name not in scenery]
        return [scene.index(name) for name in dict.fromkeys([*first, *others, *scenery])]

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
    def physical(self) -> list[Body | Cloth]:
        """The objects that the simulation moves or holds: all but scenery, which comes last."""
        return [thing for thing in self.things if isinstance(thing, Cloth) or not thing.scenery]

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
        """Positions (F, N, 3) and rotations (F, N, 4); a cloth's position is its centre."""
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


# Static groups of Drape: parameters of the cloth simulation, under the names of Flex commands.
#
# ``container`` has one number per parameter, each group of actors one row per object of its kind
# (``object_id``), all named as in the commands ``create_flex_container``,
# ``set_flex_solid_actor`` and ``set_flex_cloth_actor`` (docs/official-system.md, sections 3.8
# and 4.1). ``soft_actors`` and ``fluid_actors`` are empty, as in the originals.
#
# Parameters that the solver of this package does not have are left out: of the container
# ``radius`` (interaction distance of particles), ``max_particles``, ``max_neighbors``, drag,
# sleep, planes and everything for fluids; of cloths ``mesh_tesselation``, as sheets have vertices
# of their own.

EMPTY = ("soft_actors", "fluid_actors")
"""Groups for kinds of objects that no scene has."""


def flex_groups(objects: OfficialObjects) -> Mapping[str, Mapping[str, Any]]:
    """Return the arrays by group and name; empty for a scene without cloth."""
    if not objects.scene.cloths:
        return {}
    numbered = list(enumerate(objects.things, start=1))
    solids = [id_ for id_, thing in numbered if isinstance(thing, Body) and not thing.scenery]
    cloths = [(id_, thing) for id_, thing in numbered if isinstance(thing, Cloth)]
    settings = ClothSettings()
    container = {
        "solid_rest": settings.rest_distance,
        "collision_distance": settings.floor_gap,
        "static_friction": settings.floor_friction,
        "dynamic_friction": settings.floor_friction,
        "particle_friction": settings.particle_friction,
        "damping": settings.damping,
    }
    counts = {"substep_count": settings.substeps, "iteration_count": settings.iterations}
    stiffness = {
        f"{name}_stiffness": _floats([getattr(cloth, name) for _, cloth in cloths])
        for name in ("stretch", "bend", "tether")
    }
    return {
        "container": {name: np.float32(value) for name, value in container.items()}
        | {name: np.int64(value) for name, value in counts.items()},
        "solid_actors": {
            "object_id": np.array(solids, np.int64),
            "mass_scale": _floats([1.0] * len(solids)),
            "mesh_expansion": _floats([0.0] * len(solids)),
            "particle_spacing": _floats([settings.particle_spacing] * len(solids)),
        },
        "cloth_actors": {
            "object_id": np.array([id_ for id_, _ in cloths], np.int64),
            "mass_scale": _floats([1.0] * len(cloths)),
            **stiffness,
            "tether_give": _floats([0.0] * len(cloths)),
            "pressure": _floats([0.0] * len(cloths)),
        },
        **{name: {} for name in EMPTY},
    }


def _floats(values: list[float]) -> Any:
    return np.array(values, np.float32)


# Writing of many small arrays into an HDF5 file.
#
# A frame of an official file has about 30 arrays of some 100 bytes. ``h5py.Group.create_dataset``
# takes three times as long for each as HDF5 itself, so they are created with h5py's lower layer
# here.

_SMALL = 1024
"""Size in bytes up to which arrays are not compressed, because they would become larger."""
GZIP_LEVEL = 1
"""Level of gzip; on motion and particles, 4 takes a third more time for 2 % fewer bytes."""


def new_group(parent: Any, name: str) -> Any:
    """Create a group below a group of h5py's lower layer (``h5py.Group.id``), and return it."""
    return h5g.create(parent, name.encode())


def link(parent: Any, name: str, target: Any) -> None:
    """Enter an existing array into another group too (hard link).

    Readers find an equal array there. What frames have in common is stored once so.
    """
    h5o.link(target, parent, name.encode())


def put(group: Any, name: str, values: Any) -> Any:
    """Write an array or a scalar into a group of h5py's lower layer, and return the new array.

    Larger arrays are compressed.
    """
    array = np.asarray(values, order="C")
    space = _space(array.shape)
    large = array.ndim and array.nbytes > _SMALL
    # The values of small arrays stand in their headers.
    layout = _compressed(array.shape) if large else _compact()
    kind = _type(array.dtype)
    made = h5d.create(group, name.encode(), kind, space, layout)
    if array.size:
        made.write(h5s.ALL, h5s.ALL, array, mtype=_type_in_memory(array.dtype))
    return made


def put_bytes(group: Any, name: str, data: bytes) -> None:
    """Write bytes as an array of uint8 without compression."""
    array = np.frombuffer(data, np.uint8)
    made = h5d.create(group, name.encode(), _type(array.dtype), _space(array.shape), _plain())
    made.write(h5s.ALL, h5s.ALL, array)


def put_picture(group: Any, name: str, picture: NDArray[Any]) -> None:
    """Write a picture as one compressed chunk."""
    array = np.ascontiguousarray(picture)
    layout = _compressed(array.shape, shuffle=False)
    made = h5d.create(group, name.encode(), _type(array.dtype), _space(array.shape), layout)
    made.write(h5s.ALL, h5s.ALL, array)


@cache
def _type(dtype: np.dtype[Any]) -> Any:
    return h5t.py_create(dtype, logical=True)


@cache
def _type_in_memory(dtype: np.dtype[Any]) -> Any:
    # It differs from the stored type for texts of variable length.
    return h5t.py_create(dtype)


@cache
def _space(shape: tuple[int, ...]) -> Any:
    return h5s.create_simple(shape) if shape else h5s.create(h5s.SCALAR)


@cache
def _plain() -> Any:
    layout = h5p.create(h5p.DATASET_CREATE)
    # Equal trials give equal bytes at any time.
    layout.set_obj_track_times(False)
    return layout


@cache
def _compact() -> Any:
    layout = _plain().copy()
    layout.set_layout(h5d.COMPACT)
    return layout


@cache
def _compressed(shape: tuple[int, ...], shuffle: bool = True) -> Any:
    layout = _plain().copy()
    layout.set_chunk(shape)
    layout.set_fill_time(h5d.FILL_TIME_NEVER)
    if shuffle:
        layout.set_shuffle()
    layout.set_deflate(GZIP_LEVEL)
    return layout


# Groups ``collisions`` and ``env_collisions`` of the frames of an official file.
#
# Every pair that touches has exactly one contact point, the deepest one, at the same position in
# the list, so that points can be assigned to pairs (the originals have several points per pair).
# As in the originals, a pair that separates ("exit") has none; these records come last. Normals
# point as in Unity: from the second object of the record to the first, and from the environment to
# the object (docs/official-system.md, sections 2.6 and 4.2).


class ContactRecords:
    """Contact records of all frames of a trial."""

    def __init__(self, objects: OfficialObjects) -> None:
        self.on_floor = _frames_on_floor(objects)
        frames = len(objects.trajectory)
        pairs, environment = _rows_by_frame(objects)
        states = [state for rows in pairs for _, state in rows]
        rows = np.array([row for rows in pairs for row, _ in rows], np.int64)
        at = np.repeat(np.arange(frames), [len(rows) for rows in pairs])
        outside = np.array([row for rows in environment for row in rows], np.int64)
        points = [[row for row, state in rows if state != "exit"] for rows in pairs]
        touching = np.array([row for rows in points for row in rows], np.int64)
        pair_ends, point_ends, environment_ends = (
            np.cumsum([0, *map(len, rows)]) for rows in (pairs, points, environment)
        )
        # Arrays of all frames with the end of each frame in them, by group and name.
        self._groups = {
            "collisions": {
                **{
                    name: (array, pair_ends)
                    for name, array in _pair_arrays(objects, rows, at, states).items()
                },
                "contacts": (_normal_and_point(objects, touching, -1.0), point_ends),
            },
            "env_collisions": {
                name: (array, environment_ends)
                for name, array in _environment_arrays(objects, outside).items()
            },
        }
        # One empty array serves all frames without contacts.
        self._empty: dict[tuple[str, str], Any] = {}

    def write(self, frame_group: Any, frame: int) -> None:
        """Write both groups of a frame into its group, of h5py's lower layer."""
        for name, arrays in self._groups.items():
            group = new_group(frame_group, name)
            for key, (values, ends) in arrays.items():
                start, end = ends[frame : frame + 2]
                if start == end and (name, key) in self._empty:
                    link(group, key, self._empty[name, key])
                    continue
                made = put(group, key, values[start:end])
                if start == end:
                    self._empty[name, key] = made


def _rows_by_frame(
    objects: OfficialObjects,
) -> tuple[list[list[tuple[int, str]]], list[list[int]]]:
    """Return rows of the contact list by frame: with states for pairs, and for the environment."""
    contacts = objects.trajectory.contacts
    touching: list[dict[tuple[int, int], int]] = [{} for _ in range(len(objects.trajectory))]
    numbers = zip(contacts.frame.tolist(), contacts.bodies.tolist(), strict=True)
    for row, (frame, (a, b)) in enumerate(numbers):
        touching[frame][a, b] = row
    pairs, environment = [], []
    before: dict[tuple[int, int], int] = {}
    for now in touching:
        states = [
            (row, "stay" if pair in before else "enter")
            for pair, row in now.items()
            if pair[0] != ENVIRONMENT
        ]
        states += [
            (row, "exit")
            for pair, row in before.items()
            if pair not in now and pair[0] != ENVIRONMENT
        ]
        pairs.append(states)
        environment.append([row for pair, row in now.items() if pair[0] == ENVIRONMENT])
        before = now
    return pairs, environment


def _pair_arrays(
    objects: OfficialObjects, rows: NDArray[np.int64], at: NDArray[np.int64], states: list[str]
) -> Mapping[str, NDArray[Any]]:
    """Return the arrays of ``collisions`` with one row per record; ``at`` is the frame."""
    contacts = objects.trajectory.contacts
    bodies = contacts.bodies[rows].reshape(-1, 2)
    velocities = np.pad(
        objects.trajectory.velocities.astype(np.float64),
        ((0, 0), (0, len(objects.scene.cloths)), (0, 0)),
    )
    relative = velocities[at, bodies[:, 1]] - velocities[at, bodies[:, 0]]
    return {
        "object_ids": _official_ids(objects)[bodies],
        "relative_velocities": swap_axes(relative),
        "states": np.array(states, "S5"),
    }


def _environment_arrays(
    objects: OfficialObjects, rows: NDArray[np.int64]
) -> Mapping[str, NDArray[Any]]:
    contacts = objects.trajectory.contacts
    return {
        "object_ids": _official_ids(objects)[contacts.bodies[rows].reshape(-1, 2)[:, 1]],
        "contacts": _normal_and_point(objects, rows, 1.0),
    }


def _normal_and_point(objects: OfficialObjects, rows: NDArray[np.int64], sign: float) -> Floats:
    contacts = objects.trajectory.contacts
    both = np.stack([sign * contacts.normal[rows], contacts.point[rows]], axis=1)
    return np.asarray(swap_axes(both).reshape(-1, 2, 3))


def _official_ids(objects: OfficialObjects) -> NDArray[np.int64]:
    """Return the official object ids by index in `Scene.names`."""
    return np.array([objects.ids[name] for name in objects.scene.names()], np.int64)


def _frames_on_floor(objects: OfficialObjects) -> NDArray[np.bool_]:
    """Return in which frames (F,) the target touches the environment."""
    contacts, scene = objects.trajectory.contacts, objects.scene
    touches = (contacts.bodies == [ENVIRONMENT, scene.index(scene.roles.agent)]).all(axis=1)
    found = np.zeros(len(objects.trajectory), bool)
    found[contacts.frame[touches]] = True
    return found


# Groups ``particles`` and ``velocities`` of the frames of an official file of Drape.
#
# As in Flex, every object has particles: the vertices of a cloth, and points that fill a solid.
# Scenery, which takes no part in our simulation, has them too, because readers of the original
# files take the particles of every object id (`preprocessing_tdw_cheap.py` of Physion-particles).


class ParticleArrays:
    """Particles and their velocities in all frames, by official object id."""

    def __init__(self, objects: OfficialObjects) -> None:
        scene = objects.scene
        bodies = tuple(replace(body, scenery=False) for body in scene.bodies)
        cloud = particles_over_time(replace(scene, bodies=bodies), objects.trajectory)
        self._positions, self._velocities = {}, {}
        self._written: dict[tuple[str, str], Any] = {}
        for index, thing in zip(objects.order, objects.things, strict=True):
            mask = cloud.things == index
            now = swap_axes(cloud.positions[:, mask])
            inverse = np.full((*now.shape[:2], 1), mask.sum() / thing.mass)
            id_ = str(objects.ids[thing.name])
            self._positions[id_] = np.concatenate([now, inverse], axis=2).astype(np.float32)
            moved = np.diff(now, axis=0, prepend=now[:1])
            self._velocities[id_] = (moved / FRAME_TIME).astype(np.float32)

    def write(self, frame_group: Any, frame: int) -> None:
        """Write both groups of a frame into its group, of h5py's lower layer.

        ``particles/<id>`` is (P, 4): position in metres, inverse mass; ``velocities/<id>`` (P, 3).
        What does not change is stored once; frames must be written in order.
        """
        for name, arrays in (("particles", self._positions), ("velocities", self._velocities)):
            group = new_group(frame_group, name)
            for id_, values in arrays.items():
                if frame and np.array_equal(values[frame], values[frame - 1]):
                    link(group, id_, self._written[name, id_])
                else:
                    self._written[name, id_] = put(group, id_, values[frame])
