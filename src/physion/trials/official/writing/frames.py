"""Groups ``frames/%04d/`` of an official file: objects, contacts, labels, camera and pictures.

All arrays are computed for the whole trial at once, and then written frame by frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from physion.physics.labels import contact_frames
from physion.rendering.camera import axes
from physion.rendering.renderer import Frame
from physion.trials.official.axes import (
    rotation_matrices,
    swap_angular_velocity,
    swap_axes,
    to_official_camera,
    to_official_rotation,
)
from physion.trials.official.names import CLOTH_DISTANCE, segmentation_colors
from physion.trials.official.writing.arrays import link, new_group, put
from physion.trials.official.writing.contacts import ContactRecords
from physion.trials.official.writing.objects import OfficialObjects
from physion.trials.official.writing.particles import ParticleArrays
from physion.trials.official.writing.pictures import write_pictures

PASSES = ("color", "depth", "normals", "ids", "flow")
MOVED = 0.01
"""Displacement in metres from which a target counts as moved."""
FALLEN = 0.5
"""Fraction of its initial height below which the top of a tower counts as fallen."""

Labels = Mapping[str, NDArray[Any]]


class FrameWriter:
    """Writer of the frames of one trial; ``labels`` has the values of every frame by name."""

    def __init__(self, objects: OfficialObjects, width: int, height: int) -> None:
        self.objects = objects
        self._contacts = ContactRecords(objects)
        self._arrays = _object_arrays(objects)
        self.labels: Labels = _labels(objects, self._contacts.on_floor)
        self._particles = ParticleArrays(objects) if objects.scene.cloths else None
        self._colors = np.concatenate(
            [np.zeros((1, 3), np.uint8), segmentation_colors(len(objects))]
        )
        self._view = axes(objects.scene.camera)
        camera, projection = to_official_camera(objects.scene.camera, width, height)
        self._written: dict[str, tuple[bytes, Any]] = {}
        self._matrices = {
            "camera_matrix": camera.astype(np.float32).ravel(),
            "projection_matrix": projection.astype(np.float32).ravel(),
        }

    def add(self, frames: h5py.Group, frame: int, images: Frame | None) -> None:
        """Write ``frames/<frame>``; ``images`` holds all of `PASSES`, None leaves pictures out."""
        group = new_group(frames.id, f"{frame:04d}")
        if images is not None:
            assert images.ids is not None
            pictures = new_group(group, "images")
            ids = self.objects.official_ids(images.ids)
            write_pictures(pictures, images, ids, self._colors, self._view)
        objects = new_group(group, "objects")
        for name, values in self._arrays.items():
            self._put(objects, name, values[frame])
        self._contacts.write(group, frame)
        matrices = new_group(group, "camera_matrices")
        for name, matrix in self._matrices.items():
            self._put(matrices, name, matrix)
        labels = new_group(group, "labels")
        for name, values in self.labels.items():
            self._put(labels, name, values[frame])
        if self._particles is not None:
            self._particles.write(group, frame)

    def _put(self, group: Any, name: str, values: NDArray[Any]) -> None:
        """Write an array, or link that of the last frame if it has the same bytes.

        A link takes a fourth of the time. Objects rest, the camera always does, labels hardly ever
        change.
        """
        data = values.tobytes()
        last = self._written.get(name)
        if last is not None and last[0] == data:
            link(group, name, last[1])
        else:
            self._written[name] = (data, put(group, name, values))


def _object_arrays(objects: OfficialObjects) -> dict[str, NDArray[np.float32]]:
    """Return the arrays (F, N, 3 or 4) of the group ``objects`` by name."""
    positions, rotations = objects.poses
    velocities, angular_velocities = objects.motions
    arrays = {
        "positions": swap_axes(positions),
        "rotations": to_official_rotation(rotations),
        "forwards": swap_axes(rotation_matrices(rotations)[..., 1]),
        "velocities": swap_axes(velocities),
        "angular_velocities": swap_angular_velocity(angular_velocities),
        **{side: swap_axes(at) for side, at in objects.boxes.items()},
    }
    return {name: values.astype(np.float32) for name, values in arrays.items()}


def _labels(objects: OfficialObjects, on_floor: NDArray[np.bool_]) -> Labels:
    """Return the labels of all frames (F, ...) by name."""
    scene, trajectory = objects.scene, objects.trajectory
    frames = len(trajectory)
    last = np.arange(frames) == frames - 1
    completed, always = bool(trajectory.completed), np.ones(frames, bool)
    touching = np.zeros(frames, bool)
    touching[contact_frames(scene, trajectory)] = True
    found: dict[str, NDArray[Any]] = {
        "trial_end": last,
        "trial_timeout": last & (not completed),
        "trial_complete": last & completed,
        "has_target": always,
        "has_zone": always,
        "target_contacting_zone": touching,
    }
    target = scene.index(scene.roles.agent)
    if target < len(scene.bodies):
        # As in the originals, cloths have no such labels.
        moved = trajectory.positions[:, target] - trajectory.positions[0, target]
        found["target_delta_position"] = swap_axes(moved).astype(np.float32)
        found["target_has_moved"] = np.linalg.norm(moved, axis=1) > MOVED
        found["target_on_ground"] = on_floor
    if scene.cloths:
        gaps = trajectory.cloth_distance + CLOTH_DISTANCE
        found["minimum_distance_target_to_zone"] = gaps.astype(np.float32)
    if scene.scenario == "support":
        tops = _tower_tops(objects)
        found["did_fall"] = tops < FALLEN * tops[0]
    return found


def _tower_tops(objects: OfficialObjects) -> NDArray[np.float64]:
    """Return the heights (F,) in metres of the top of the tower on the zone, without the probe."""
    scene = objects.scene
    stack = [*objects.middle, *(b for b in scene.bodies if b.name == scene.roles.agent)]
    rows = [objects.ids[body.name] - 1 for body in stack]
    if not rows:
        return np.zeros(len(objects.trajectory))
    boxes = {side: heights[:, rows, 2] for side, heights in objects.boxes.items()}
    center = boxes["center"]
    reach = sum(np.abs(boxes[side] - center) for side in ("front", "left", "top"))
    return np.asarray((center + reach).max(axis=1))
