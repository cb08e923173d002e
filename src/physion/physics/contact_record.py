"""Sum up the recorded contacts of a simulation pair by pair."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.physics.trajectory import ENVIRONMENT, Contacts


def summarise_contacts(
    frame: NDArray[np.int64], pair: NDArray[np.int64], row: NDArray[np.float64], floor: int
) -> Contacts:
    """Return one contact for each touching pair and frame: its deepest point, its whole impulse.

    ``frame`` (R,), ``pair`` (R, 2) and ``row`` (R, 8) are those of
    `physion.physics.rigid.step.History`; body ``floor`` is the floor.
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
