"""Contacts of a simulation: collect them step by step, and sum them up pair by pair."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.physics.contact_record import summarise_contacts
from physion.physics.trajectory import ENVIRONMENT, Contacts

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
        self._frames.append(np.full(len(pairs), frame))
        self._pairs.append(pairs)
        self._values.append(np.column_stack([points, normals, impulses, gaps]))

    def touches(self, frame: int, pair: tuple[int, int]) -> bool:
        """Return whether two bodies touch in ``frame``, the latest one."""
        for at, pairs in zip(reversed(self._frames), reversed(self._pairs), strict=True):
            if at[0] != frame:
                break
            if (np.sort(pairs, axis=1) == sorted(pair)).all(axis=1).any():
                return True
        return False

    def contacts(self) -> Contacts:
        """Return one row for each touching pair and frame: its deepest point, its whole impulse."""
        if not self._frames:
            return Contacts.empty()
        pairs, values = np.concatenate(self._pairs), np.concatenate(self._values)
        return summarise_contacts(np.concatenate(self._frames), pairs, values, ENVIRONMENT)
