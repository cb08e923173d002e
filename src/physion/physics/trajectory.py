"""Motion of a scene as arrays over frames, independent of the engine and of rendering."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.scenes.scene import FRAME_TIME

Floats = NDArray[np.float32]
Ints = NDArray[np.int32]

ENVIRONMENT = -1
"""Body index of the floor in contacts."""


@dataclass(frozen=True)
class Contacts:
    """Contacts of a trajectory: one row for each touching pair in each frame, at its deepest point.

    A pair touches where its impulse is above 0 or its surfaces meet. `RigidEngine` records no
    contacts of pairs in which nothing is awake: they end when the pair falls asleep.

    - ``frame`` (C,): the frame that shows the contact.
    - ``bodies`` (C, 2): indices of `Scene.names`, the smaller first; `ENVIRONMENT` is the floor.
    - ``point`` (C, 3): metres, world. ``normal`` (C, 3): unit, from the first to the second body.
    - ``impulse`` (C,): newton seconds along the normal during the frame, all points summed.
    """

    frame: Ints
    bodies: Ints
    point: Floats
    normal: Floats
    impulse: Floats

    @classmethod
    def empty(cls) -> Contacts:
        """Return a set without contacts."""
        return cls(
            np.zeros(0, np.int32),
            np.zeros((0, 2), np.int32),
            np.zeros((0, 3), np.float32),
            np.zeros((0, 3), np.float32),
            np.zeros(0, np.float32),
        )

    def frames_of(self, a: int, b: int) -> Ints:
        """Return the sorted frames in which bodies ``a`` and ``b`` touch."""
        pair = np.array([min(a, b), max(a, b)])
        return np.unique(self.frame[(self.bodies == pair).all(axis=1)])


@dataclass(frozen=True)
class State:
    """State of a scene at one instant, from which an engine can continue.

    Arrays are as in `Trajectory`, without the frame axis. ``frame`` counts from the start of the
    trial, so that later pushes still take place.
    """

    frame: int
    positions: NDArray[np.float64]
    rotations: NDArray[np.float64]
    velocities: NDArray[np.float64]
    angular_velocities: NDArray[np.float64]
    cloth_vertices: NDArray[np.float64]
    cloth_velocities: NDArray[np.float64]


@dataclass(frozen=True)
class Trajectory:
    """Motion of a scene: F frames, N rigid bodies, V cloth vertices.

    - ``positions`` (F, N, 3): metres, of each body's pivot. Frame 0 follows the first step, as in
      the official recordings, or is the state from which a simulation was continued.
    - ``rotations`` (F, N, 4): unit quaternions (w, x, y, z).
    - ``velocities`` (F, N, 3): metres per second, of the centre of mass.
    - ``angular_velocities`` (F, N, 3): radians per second, world axes.
    - ``cloth_vertices`` (F, V, 3): metres; the cloths of the scene one after the other, each
      row by row along x then y. V is 0 without cloth.
    - ``completed``: all bodies came to rest before the time was over.
    - ``cloth_distance`` (F,): smallest gap in metres between the cloth's surface and the other
      body of the question (agent or patient); NaN without cloth.
    """

    positions: Floats
    rotations: Floats
    velocities: Floats
    angular_velocities: Floats
    cloth_vertices: Floats
    cloth_distance: Floats
    contacts: Contacts
    completed: bool
    engine: str

    def __post_init__(self) -> None:
        frames = len(self.positions)
        for name in ("rotations", "velocities", "angular_velocities", "cloth_vertices"):
            if len(getattr(self, name)) != frames:
                raise BadInputError(
                    f"trajectory: {name} must have the {frames} frames of positions"
                )

    def __len__(self) -> int:
        return len(self.positions)

    def state(self, frame: int) -> State:
        """Return the state at ``frame``, from which another simulation can start."""
        cloth = self.cloth_vertices.astype(np.float64)
        # Frame 0 follows a step from rest, whose start is not stored.
        before = max(frame - 1, 0)
        return State(
            frame,
            self.positions[frame].astype(np.float64),
            self.rotations[frame].astype(np.float64),
            self.velocities[frame].astype(np.float64),
            self.angular_velocities[frame].astype(np.float64),
            cloth[frame],
            (cloth[frame] - cloth[before]) / FRAME_TIME,
        )

    def digest(self) -> str:
        """Return the hexadecimal SHA-256 of all arrays: equal trajectories have equal digests."""
        sha = hashlib.sha256()
        contacts = self.contacts
        for array in (
            self.positions,
            self.rotations,
            self.velocities,
            self.angular_velocities,
            self.cloth_vertices,
            self.cloth_distance,
            contacts.frame,
            contacts.bodies,
            contacts.point,
            contacts.normal,
            contacts.impulse,
        ):
            sha.update(repr((array.shape, array.dtype.str)).encode())
            sha.update(np.ascontiguousarray(array).tobytes())
        return sha.hexdigest()


# Sum up the recorded contacts of a simulation pair by pair.


def summarise_contacts(
    frame: NDArray[np.int64], pair: NDArray[np.int64], row: NDArray[np.float64], floor: int
) -> Contacts:
    """Return one contact for each touching pair and frame: its deepest point, its whole impulse.

    ``frame`` (R,), ``pair`` (R, 2) and ``row`` (R, 8) as in `physion.physics.rigid.step.History`;
    body ``floor`` is the floor.
    """
    if not len(frame):
        return Contacts.empty()
    pair, row = np.where(pair == floor, ENVIRONMENT, pair), row.copy()
    swap = pair[:, 0] > pair[:, 1]
    pair[swap] = pair[swap, ::-1]
    row[swap, 3:6] *= -1.0
    # The deepest point of each pair comes first.
    order = np.lexsort((row[:, 7], pair[:, 1], pair[:, 0], frame))
    frame, pair, row = frame[order], pair[order], row[order]
    new = np.ones(len(frame), bool)
    new[1:] = (np.diff(frame) != 0) | (np.diff(pair, axis=0) != 0).any(axis=1)
    first = np.flatnonzero(new)
    return Contacts(
        frame=frame[first].astype(np.int32),
        bodies=pair[first].astype(np.int32),
        point=row[first, 0:3].astype(np.float32),
        normal=row[first, 3:6].astype(np.float32),
        impulse=_sum_groups(row[:, 6], first).astype(np.float32),
    )


def _sum_groups(values: NDArray[np.float64], starts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return the sums of the values from each start to the next, added in order."""
    total = np.zeros(len(starts))
    group = np.zeros(len(values), np.int64)
    group[starts[1:]] = 1
    np.add.at(total, np.cumsum(group), values)
    return total
