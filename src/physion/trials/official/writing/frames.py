"""Groups ``frames/%04d/`` of an official file: objects, contacts, labels, camera and pictures.

Unlike in the originals, every contact record has exactly one contact point, the deepest one, at the
same position in the list, so that points can be assigned to pairs (the originals have several
points per pair, and none for pairs that separate). A pair that separates ("exit") repeats its last
point. Normals point as in Unity: from the second object of the record to the first, and from the
environment to the object (docs/official-system.md, sections 2.6 and 4.2).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from physion.physics.labels import contact_frames
from physion.physics.particles import particles_over_time
from physion.physics.trajectory import ENVIRONMENT
from physion.rendering.camera import axes
from physion.rendering.renderer import Frame
from physion.scenes.scene import FRAME_TIME
from physion.trials.files import encode_png
from physion.trials.official.axes import (
    rotation_matrices,
    swap_angular_velocity,
    swap_axes,
    to_official_camera,
    to_official_rotation,
)
from physion.trials.official.names import (
    CLOTH_DISTANCE,
    encode_depth,
    encode_flow,
    encode_normals,
    segmentation_colors,
)
from physion.trials.official.writing.objects import OfficialObjects

PASSES = ("color", "depth", "normals", "ids", "flow")
MOVED = 0.01
"""Displacement in metres from which a target counts as moved."""
FALLEN = 0.5
"""Fraction of its initial height below which the top of a tower counts as fallen."""
_SMALL = 1024
"""Size in bytes up to which arrays are not compressed, because they would become larger."""


def put(group: h5py.Group, name: str, values: Any) -> None:
    """Write an array or a scalar; compress larger arrays with gzip."""
    array = np.asarray(values)
    packed = (
        {"compression": "gzip", "compression_opts": 4}
        if array.ndim and array.nbytes > _SMALL
        else {}
    )
    group.create_dataset(name, data=array, **packed)


@dataclass
class FrameWriter:
    """Writer of the frames of one trial, in order; keeps what the record of the trial needs."""

    objects: OfficialObjects
    width: int
    height: int
    masks: dict[int, NDArray[np.int16]] = field(default_factory=dict)
    """Object ids by pixel, 0 the room, of the first and the last frame."""
    labels: dict[str, list[Any]] = field(default_factory=dict)
    """Values of every frame by the name of the label."""

    def __post_init__(self) -> None:
        scene, trajectory = self.objects.scene, self.objects.trajectory
        self._touching = frozenset(contact_frames(scene, trajectory).tolist())
        self._before: dict[tuple[int, int], int] = {}
        self._colors = np.concatenate(
            [np.zeros((1, 3), np.uint8), segmentation_colors(len(self.objects))]
        )
        # Official object ids by id of the renderer (index in `Scene.names` plus 1).
        self._official_ids = np.zeros(len(self.objects) + 1, np.int16)
        self._official_ids[np.array(self.objects.order) + 1] = np.arange(1, len(self.objects) + 1)
        self._camera = to_official_camera(scene.camera, self.width, self.height)

    def add(self, frames: h5py.Group, frame: int, images: Frame) -> None:
        """Write ``frames/<frame>``; ``images`` holds all of `PASSES`."""
        group = frames.create_group(f"{frame:04d}")
        self._write_images(group.create_group("images"), frame, images)
        self._write_objects(group.create_group("objects"), frame)
        self._write_collisions(group, frame)
        matrices = group.create_group("camera_matrices")
        put(matrices, "camera_matrix", self._camera[0].astype(np.float32).ravel())
        put(matrices, "projection_matrix", self._camera[1].astype(np.float32).ravel())
        labels = group.create_group("labels")
        for name, value in self._labels(frame).items():
            self.labels.setdefault(name, []).append(value)
            put(labels, name, value)
        if self.objects.scene.cloths:
            self._write_particles(group, frame)

    def _write_images(self, group: h5py.Group, frame: int, images: Frame) -> None:
        assert images.color is not None and images.depth is not None and images.ids is not None
        assert images.normals is not None and images.flow is not None
        ids = self._official_ids[images.ids]
        if frame in (0, len(self.objects.trajectory) - 1):
            self.masks[frame] = ids
        view = axes(self.objects.scene.camera)
        pictures = {
            "_img": images.color,
            "_id": self._colors[ids],
            "_normals": encode_normals(images.normals, view),
            "_flow": encode_flow(images.flow),
        }
        for name, picture in pictures.items():
            # PNG is compressed already; level 2 takes half the time of 6 for a tenth more bytes.
            data = np.frombuffer(encode_png(picture, compress_level=2), np.uint8)
            group.create_dataset(name, data=data)
        depth = encode_depth(images.depth)
        packed: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": False}
        group.create_dataset("_depth", data=depth, chunks=depth.shape, **packed)

    def _write_objects(self, group: h5py.Group, frame: int) -> None:
        positions, rotations = (values[frame] for values in self.objects.poses)
        velocities, angular_velocities = (values[frame] for values in self.objects.motions)
        arrays = {
            "positions": swap_axes(positions),
            "rotations": to_official_rotation(rotations),
            "forwards": swap_axes(rotation_matrices(rotations)[:, :, 1]),
            "velocities": swap_axes(velocities),
            "angular_velocities": swap_angular_velocity(angular_velocities),
            **{side: swap_axes(at) for side, at in self.objects.boxes(frame).items()},
        }
        for name, values in arrays.items():
            put(group, name, values.astype(np.float32))

    def _write_collisions(self, frame_group: h5py.Group, frame: int) -> None:
        now = self._contacts[frame]
        rows: list[tuple[int, str]] = []
        for pair, row in now.items():
            rows.append((row, "stay" if pair in self._before else "enter"))
        rows += [(row, "exit") for pair, row in self._before.items() if pair not in now]
        self._before = now
        contacts = self.objects.trajectory.contacts
        environment = [row for row, state in rows if contacts.bodies[row, 0] == ENVIRONMENT]
        environment = [row for row in environment if contacts.frame[row] == frame]
        pairs = [(row, state) for row, state in rows if contacts.bodies[row, 0] != ENVIRONMENT]
        chosen = np.array([row for row, _ in pairs], np.int64)
        velocities = self.objects.trajectory.velocities[frame].astype(np.float64)
        velocities = np.pad(velocities, ((0, len(self.objects.scene.cloths)), (0, 0)))
        bodies = contacts.bodies[chosen]
        group = frame_group.create_group("collisions")
        put(group, "object_ids", self._ids[bodies].reshape(-1, 2))
        relative = velocities[bodies[:, 1]] - velocities[bodies[:, 0]]
        put(group, "relative_velocities", swap_axes(relative).astype(np.float32).reshape(-1, 3))
        put(group, "states", np.array([state for _, state in pairs], "S5"))
        put(group, "contacts", self._normal_and_point(chosen, -1.0))
        group = frame_group.create_group("env_collisions")
        outside = np.array(environment, np.int64)
        put(group, "object_ids", self._ids[contacts.bodies[outside, 1]])
        put(group, "contacts", self._normal_and_point(outside, 1.0))

    def _normal_and_point(self, rows: NDArray[np.int64], sign: float) -> NDArray[np.float32]:
        contacts = self.objects.trajectory.contacts
        both = np.stack([sign * contacts.normal[rows], contacts.point[rows]], axis=1)
        return np.asarray(swap_axes(both).astype(np.float32).reshape(-1, 2, 3))

    @cached_property
    def _ids(self) -> NDArray[np.int64]:
        """Official object ids by index in `Scene.names`."""
        names = self.objects.scene.names()
        return np.array([self.objects.ids[name] for name in names])

    @cached_property
    def _contacts(self) -> list[dict[tuple[int, int], int]]:
        """For each frame the rows of the contacts by touching pair."""
        found: list[dict[tuple[int, int], int]] = [{} for _ in range(len(self.objects.trajectory))]
        contacts = self.objects.trajectory.contacts
        for row, (frame, (a, b)) in enumerate(zip(contacts.frame, contacts.bodies, strict=True)):
            found[frame][int(a), int(b)] = row
        return found

    def _labels(self, frame: int) -> dict[str, Any]:
        scene, trajectory = self.objects.scene, self.objects.trajectory
        last = frame == len(trajectory) - 1
        found: dict[str, Any] = {
            "trial_end": last,
            "trial_timeout": last and not trajectory.completed,
            "trial_complete": last and bool(trajectory.completed),
            "has_target": True,
            "has_zone": True,
            "target_contacting_zone": frame in self._touching,
        }
        target = scene.index(scene.roles.agent)
        if target < len(scene.bodies):
            # As in the originals, cloths have no such labels.
            moved = trajectory.positions[frame, target] - trajectory.positions[0, target]
            found["target_delta_position"] = swap_axes(moved).astype(np.float32)
            found["target_has_moved"] = bool(np.linalg.norm(moved) > MOVED)
            found["target_on_ground"] = (ENVIRONMENT, target) in self._contacts[frame]
        if scene.cloths:
            gap = np.float32(trajectory.cloth_distance[frame] + CLOTH_DISTANCE)
            found["minimum_distance_target_to_zone"] = gap
        if scene.scenario == "support":
            tops = [self._tower_top(at) for at in (0, frame)]
            found["did_fall"] = bool(tops[1] < FALLEN * tops[0])
        return found

    def _tower_top(self, frame: int) -> float:
        """Return the height in metres of the top of the tower on the zone, without the probe."""
        scene = self.objects.scene
        stack = [*self.objects.middle, *(b for b in scene.bodies if b.name == scene.roles.agent)]
        rows = [self.objects.ids[body.name] - 1 for body in stack]
        boxes = self.objects.boxes(frame)
        center = boxes["center"][rows]
        reach = sum(np.abs(boxes[side][rows] - center)[:, 2] for side in ("front", "left", "top"))
        return float((center[:, 2] + reach).max()) if rows else 0.0

    def _write_particles(self, frame_group: h5py.Group, frame: int) -> None:
        """Write particles of cloths and solids as in Flex: position, inverse mass, velocity."""
        scene, trajectory = self.objects.scene, self.objects.trajectory
        cloud = particles_over_time(scene, trajectory, frames=[max(frame - 1, 0), frame])
        before, now = swap_axes(cloud.positions)
        particles = frame_group.create_group("particles")
        velocities = frame_group.create_group("velocities")
        for index, thing in enumerate(self.objects.things):
            mask = cloud.things == self.objects.order[index]
            if mask.any():
                inverse = np.full((int(mask.sum()), 1), mask.sum() / thing.mass)
                id_ = str(self.objects.ids[thing.name])
                put(particles, id_, np.hstack([now[mask], inverse]).astype(np.float32))
                speed = (now[mask] - before[mask]) / FRAME_TIME
                put(velocities, id_, speed.astype(np.float32))
