"""Pairs of particles that are close, or will be within a step.

Two particles at x and y that move by u and v during a step are at the time s in 0..1 of the step
at the distance |d + s w| with d = y - x and w = v - u. It is smallest at

    s* = min(max(-(d . w) / (w . w), 0), 1)

A pair is *swept* if that smallest distance is at most the radius.

Boxes of objects are compared first, then particles.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Edges = tuple[I64, I64]
"""Receivers and senders (E,)."""


def swept_edges(
    points: F64,
    displacements: F64,
    starts: I64,
    scene: I64,
    moves: NDArray[np.bool_],
    radius: float,
) -> Edges:
    """Return the pairs of particles of different objects that come within ``radius`` in a step.

    Both directions of a pair are returned, sorted by receiver, then sender.

    Parameters
    ----------
    points, displacements : (P, 3)
        Metres; where each particle goes in the step. With displacements of 0 the pairs are those
        that are within the radius now.
    starts : (K + 1,)
        Rows at which the particles of each object begin, and P.
    scene : (K,)
        Number of the scene of each object; scenes are in blocks.
    moves : (K,)
        Whether an object can move; pairs of two objects that cannot are left out.
    radius : float
        Metres.
    """
    first, second = _swept_pairs(
        np.ascontiguousarray(points, np.float64),
        np.ascontiguousarray(displacements, np.float64),
        np.ascontiguousarray(starts, np.int64),
        np.ascontiguousarray(scene, np.int64),
        np.ascontiguousarray(moves, np.bool_),
        float(radius),
    )
    return _both_ways(first, second)


def near_edges(points: F64, starts: I64, moves: NDArray[np.bool_], radius: float) -> Edges:
    """Return the pairs of particles of one object that are closer than ``radius``.

    Both directions of a pair are returned, sorted by receiver, then sender.

    Parameters
    ----------
    points : (P, 3)
        Metres.
    starts : (K + 1,)
        Rows at which the particles of each object begin, and P.
    moves : (K,)
        Whether an object can move; those that cannot have no edges within.
    radius : float
        Metres.
    """
    first, second = _near_pairs(
        np.ascontiguousarray(points, np.float64),
        np.ascontiguousarray(starts, np.int64),
        np.ascontiguousarray(moves, np.bool_),
        float(radius),
    )
    return _both_ways(first, second)


def gap_over_time(a: F64, b: F64) -> float:
    """Return the smallest distance over T frames and between them of particles (T, A or B, 3)."""
    best = np.inf
    for frame in range(max(len(a) - 1, 1)):
        after = min(frame + 1, len(a) - 1)
        best = _smallest_gap(a[frame], a[after] - a[frame], b[frame], b[after] - b[frame], best)
    return float(best)


def _both_ways(first: I64, second: I64) -> Edges:
    """Return both directions of pairs, sorted by receiver, then sender."""
    a, b = first.astype(np.int64), second.astype(np.int64)
    # Both rows in one number, which sorts faster than two.
    codes = np.concatenate([a << 32 | b, b << 32 | a])
    codes.sort()
    return codes >> 32, codes & 0xFFFFFFFF


@kernel
def _swept_pairs(
    points: F64, steps: F64, starts: I64, scene: I64, moves: NDArray[np.bool_], radius: float
) -> tuple[I64, I64]:
    """Return the pairs (E,), (E,) of `swept_edges` in one direction."""
    objects = len(starts) - 1
    low = np.full((objects, 3), np.inf)
    high = np.full((objects, 3), -np.inf)
    for k in range(objects):
        for i in range(starts[k], starts[k + 1]):
            for c in range(3):
                end = points[i, c] + steps[i, c]
                low[k, c] = min(low[k, c], points[i, c], end)
                high[k, c] = max(high[k, c], points[i, c], end)
    first = np.empty(64, np.int64)
    second = np.empty(64, np.int64)
    count = 0
    for a in range(objects):
        for b in range(a + 1, objects):
            if scene[b] != scene[a]:
                break
            if not (moves[a] or moves[b]) or not _boxes_meet(
                low[a], high[a], low[b], high[b], radius
            ):
                continue
            for i in range(starts[a], starts[a + 1]):
                if not _reaches(points[i], steps[i], low[b], high[b], radius):
                    continue
                for j in range(starts[b], starts[b + 1]):
                    if _closest(points[i], steps[i], points[j], steps[j]) > radius * radius:
                        continue
                    if count == len(first):
                        more = np.empty(2 * count, np.int64)
                        more[:count] = first
                        first = more
                        more = np.empty(2 * count, np.int64)
                        more[:count] = second
                        second = more
                    first[count] = i
                    second[count] = j
                    count += 1
    return first[:count], second[:count]


@kernel
def _near_pairs(
    points: F64, starts: I64, moves: NDArray[np.bool_], radius: float
) -> tuple[I64, I64]:
    """Return the pairs (E,), (E,) of `near_edges` in one direction."""
    first = np.empty(64, np.int64)
    second = np.empty(64, np.int64)
    count = 0
    for k in range(len(starts) - 1):
        if not moves[k]:
            continue
        for i in range(starts[k], starts[k + 1]):
            for j in range(i + 1, starts[k + 1]):
                squared = 0.0
                for c in range(3):
                    squared += (points[j, c] - points[i, c]) ** 2
                if squared >= radius * radius:
                    continue
                if count == len(first):
                    more = np.empty(2 * count, np.int64)
                    more[:count] = first
                    first = more
                    more = np.empty(2 * count, np.int64)
                    more[:count] = second
                    second = more
                first[count] = i
                second[count] = j
                count += 1
    return first[:count], second[:count]


@kernel
def _smallest_gap(a: F64, a_step: F64, b: F64, b_step: F64, best: float) -> float:
    """Return the smaller of ``best`` and the smallest distance of the particles in a step."""
    low = np.full(3, np.inf)
    high = np.full(3, -np.inf)
    for j in range(len(b)):
        for c in range(3):
            end = b[j, c] + b_step[j, c]
            low[c] = min(low[c], b[j, c], end)
            high[c] = max(high[c], b[j, c], end)
    squared = best * best
    for i in range(len(a)):
        # A particle that stays farther from the box of the others than the best cannot improve it.
        if not _reaches(a[i], a_step[i], low, high, np.sqrt(squared)):
            continue
        for j in range(len(b)):
            squared = min(squared, _closest(a[i], a_step[i], b[j], b_step[j]))
    return float(np.sqrt(squared))


@kernel
def _closest(x: F64, u: F64, y: F64, v: F64) -> float:
    """Return the smallest squared distance of two particles in a step; see the module."""
    dd, dw, ww = 0.0, 0.0, 0.0
    for c in range(3):
        d = y[c] - x[c]
        w = v[c] - u[c]
        dd += d * d
        dw += d * w
        ww += w * w
    if ww == 0.0 or dw >= 0.0:
        return dd
    s = min(-dw / ww, 1.0)
    return max(dd + 2.0 * s * dw + s * s * ww, 0.0)


@kernel
def _boxes_meet(low: F64, high: F64, other_low: F64, other_high: F64, radius: float) -> bool:
    for c in range(3):
        if low[c] > other_high[c] + radius or other_low[c] > high[c] + radius:
            return False
    return True


@kernel
def _reaches(point: F64, step: F64, low: F64, high: F64, radius: float) -> bool:
    """Return whether the box of a moving particle comes within ``radius`` of a box."""
    for c in range(3):
        end = point[c] + step[c]
        if min(point[c], end) > high[c] + radius or max(point[c], end) < low[c] - radius:
            return False
    return True
