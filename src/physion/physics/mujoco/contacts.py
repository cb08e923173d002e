"""Contacts of a simulation: collect them step by step, and sum them up pair by pair."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.physics.trajectory import Contacts

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


class ContactRows:
    """Touching points of all steps so far."""

    def __init__(self) -> None:
        self._frames: list[I64] = []
        self._pairs: list[I64] = []
        self._values: list[F64] = []

    def add(
        self, frame: int, pairs: I64, points: F64, normals: F64, impulses: F64, gaps: F64
    ) -> None:
        """Add the touching points of a step that leads to ``frame``.

        Parameters
        ----------
        frame
            Index of the frame in the trajectory.
        pairs : (C, 2)
            Scene bodies, or the floor.
        points, normals : (C, 3)
            Metres; unit vectors from the first to the second body. World axes.
        impulses, gaps : (C,)
            Newton seconds along the normal; metres, negative where surfaces overlap.
        """
        if len(pairs) == 0:
            return
        swap = pairs[:, 0] > pairs[:, 1]
        sign = np.where(swap, -1.0, 1.0)[:, None]
        self._frames.append(np.full(len(pairs), frame))
        self._pairs.append(np.where(swap[:, None], pairs[:, ::-1], pairs))
        self._values.append(np.column_stack([points, sign * normals, impulses, gaps]))

    def touches(self, frame: int, pair: tuple[int, int]) -> bool:
        """Return whether two bodies, the lower index first, touch in ``frame``, the latest one."""
        for at, pairs in zip(reversed(self._frames), reversed(self._pairs), strict=True):
            if at[0] != frame:
                break
            if (pairs == pair).all(axis=1).any():
                return True
        return False

    def contacts(self) -> Contacts:
        """Return one row for each touching pair and frame: its deepest point, its whole impulse."""
        if not self._frames:
            return Contacts.empty()
        frame, pair = np.concatenate(self._frames), np.concatenate(self._pairs)
        value = np.concatenate(self._values)
        order = np.lexsort((value[:, 7], pair[:, 1], pair[:, 0], frame))
        frame, pair, value = frame[order], pair[order], value[order]
        first = np.ones(len(frame), np.bool_)
        first[1:] = (np.diff(frame) != 0) | (np.diff(pair, axis=0) != 0).any(axis=1)
        impulse = np.zeros(np.count_nonzero(first))
        np.add.at(impulse, np.cumsum(first) - 1, value[:, 6])
        return Contacts(
            frame=frame[first].astype(np.int32),
            bodies=pair[first].astype(np.int32),
            point=value[first, 0:3].astype(np.float32),
            normal=value[first, 3:6].astype(np.float32),
            impulse=impulse.astype(np.float32),
        )
