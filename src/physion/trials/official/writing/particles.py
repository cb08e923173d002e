"""Groups ``particles`` and ``velocities`` of the frames of an official file of Drape.

As in Flex, every object has particles: the vertices of a cloth, and points that fill a solid.
Scenery, which takes no part in our simulation, has them too, because readers of the original files
take the particles of every object id (`preprocessing_tdw_cheap.py` of Physion-particles).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from physion.physics.particles import particles_over_time
from physion.scenes.scene import FRAME_TIME
from physion.trials.official.axes import swap_axes
from physion.trials.official.writing.arrays import link, new_group, put
from physion.trials.official.writing.objects import OfficialObjects


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
