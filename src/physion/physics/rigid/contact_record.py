"""Collect the contacts of a simulation frame by frame, and sum them up pair by pair."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.physics.rigid.solver_records import ContactSet
from physion.physics.trajectory import Contacts

TOUCH_GAP = 0.0
"""Metres of separation up to which a contact without impulse counts as a touch."""


class ContactRecord:
    """Contacts of all frames so far."""

    def __init__(self) -> None:
        self._frames: list[NDArray[np.int64]] = []
        self._rows: list[NDArray[np.float64]] = []
        self._pairs: list[NDArray[np.int64]] = []

    def add(
        self,
        frame: int,
        contacts: ContactSet,
        pairs: NDArray[np.int64],
        normal_impulse: NDArray[np.float64],
    ) -> None:
        """Add the contacts of the step that led to ``frame``; those that do not touch are left out.

        ``pairs`` (C, 2) are their scene bodies, ``normal_impulse`` (C,) their impulses in N s.
        """
        touch = (normal_impulse > 0.0) | (contacts.separation <= TOUCH_GAP)
        if not touch.any():
            return
        self._frames.append(np.full(np.count_nonzero(touch), frame))
        self._pairs.append(pairs[touch])
        columns = [contacts.point, contacts.normal, normal_impulse, contacts.separation]
        self._rows.append(np.column_stack(columns)[touch])

    def touches(self, pair: set[int]) -> bool:
        """Return whether the two bodies touch in the last frame that had a contact."""
        if not self._pairs:
            return False
        low, high = min(pair), max(pair)
        last = np.sort(self._pairs[-1], axis=1)
        return bool(((last[:, 0] == low) & (last[:, 1] == high)).any())

    def contacts(self) -> Contacts:
        """Return one row for each touching pair and frame: its deepest point, its whole impulse."""
        if not self._frames:
            return Contacts.empty()
        frame = np.concatenate(self._frames)
        pair = np.concatenate(self._pairs)
        row = np.concatenate(self._rows)
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
    group = np.cumsum(np.isin(np.arange(len(values)), starts)) - 1
    np.add.at(total, group, values)
    return total
