"""Groups ``collisions`` and ``env_collisions`` of the frames of an official file.

Unlike in the originals, every contact record has exactly one contact point, the deepest one, at the
same position in the list, so that points can be assigned to pairs (the originals have several
points per pair, and none for pairs that separate). A pair that separates ("exit") repeats its last
point. Normals point as in Unity: from the second object of the record to the first, and from the
environment to the object (docs/official-system.md, sections 2.6 and 4.2).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.physics.trajectory import ENVIRONMENT
from physion.trials.official.axes import swap_axes
from physion.trials.official.writing.arrays import link, new_group, put
from physion.trials.official.writing.objects import OfficialObjects


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
        self._pairs = _pair_arrays(objects, rows, at, states)
        self._environment = _environment_arrays(objects, outside)
        # One empty array serves all frames without contacts.
        self._empty: dict[tuple[str, str], Any] = {}
        self._pair_ends = np.cumsum([0, *map(len, pairs)])
        self._environment_ends = np.cumsum([0, *map(len, environment)])

    def write(self, frame_group: Any, frame: int) -> None:
        """Write both groups of a frame into its group, of h5py's lower layer."""
        for name, arrays, ends in (
            ("collisions", self._pairs, self._pair_ends),
            ("env_collisions", self._environment, self._environment_ends),
        ):
            start, end = ends[frame : frame + 2]
            group = new_group(frame_group, name)
            for key, values in arrays.items():
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
    """Return the arrays of ``collisions`` of all frames, one row each; ``at`` is the frame."""
    contacts = objects.trajectory.contacts
    bodies = contacts.bodies[rows].reshape(-1, 2)
    velocities = np.pad(
        objects.trajectory.velocities.astype(np.float64),
        ((0, 0), (0, len(objects.scene.cloths)), (0, 0)),
    )
    relative = velocities[at, bodies[:, 1]] - velocities[at, bodies[:, 0]]
    return {
        "object_ids": _official_ids(objects)[bodies],
        "relative_velocities": swap_axes(relative).astype(np.float32),
        "states": np.array(states, "S5"),
        "contacts": _normal_and_point(objects, rows, -1.0),
    }


def _environment_arrays(
    objects: OfficialObjects, rows: NDArray[np.int64]
) -> Mapping[str, NDArray[Any]]:
    contacts = objects.trajectory.contacts
    return {
        "object_ids": _official_ids(objects)[contacts.bodies[rows].reshape(-1, 2)[:, 1]],
        "contacts": _normal_and_point(objects, rows, 1.0),
    }


def _normal_and_point(
    objects: OfficialObjects, rows: NDArray[np.int64], sign: float
) -> NDArray[np.float32]:
    contacts = objects.trajectory.contacts
    both = np.stack([sign * contacts.normal[rows], contacts.point[rows]], axis=1)
    return np.asarray(swap_axes(both).astype(np.float32).reshape(-1, 2, 3))


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
