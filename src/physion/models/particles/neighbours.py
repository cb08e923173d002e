"""Pairs of particles that are close, or will be within a step: on a CPU, and on any device.

Two particles at x and y that move by u and v during a step are at the time s in 0..1 of the step
at the distance |d + s w| with d = y - x and w = v - u. It is smallest at

    s* = min(max(-(d . w) / (w . w), 0), 1)

A pair is *swept* if that smallest distance is at most the radius.

`swept_edges` compares boxes of objects, then particles, on the CPU. `swept_edges_on_device` is a
cell list in torch for a GPU: it finds the same pairs, but on a CPU it is slower.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from physion.core.errors import BadInputError
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


# The same pairs by a cell list in torch.
#
# Space is cut into cubes with edges
# of at least the reach of the search. The number of a cube is ``((scene * nx + x) * ny + y) * nz +
# z``; particles are sorted by it. What is within reach lies in the 27 cubes around a particle: the
# three along z have consecutive numbers, so that 9 ranges of sorted particles hold them all.
#
# Swept pairs are searched at moments of the step. Between
# two moments that are 1/K of a step apart, each particle is at most |u| / 2K from where it is in
# the middle, so a pair that comes within the radius r is then at most r + (|u| + |v|) / 2K apart.
# Slow particles need one moment, and most are slow; for pairs with a fast one, K grows with the
# speed.

MAX_METRES = 1e9
"""Positions and displacements from here on count as diverged."""
MARGIN = 1 + 1e-6
"""Factor of the reach that covers rounding errors; all is computed in float64."""
CANDIDATES_AT_ONCE = 1 << 22
"""Pairs whose distances are computed together, about 0.3 GB."""
SLOW = 0.25
"""Displacement in radii up to which a particle is slow."""
MOMENTS = 64
"""Largest number of moments; for still faster particles the reach grows instead."""


class _Cells(NamedTuple):
    """Cubes of particles.

    - ``numbers`` (P,): cube of each particle. ``ordered`` (P,): the same, sorted.
    - ``order`` (P,): particles in that order.
    - ``columns`` (9,): what to add to the number of a cube for the 9 columns of cubes around it.
    """

    numbers: Tensor
    ordered: Tensor
    order: Tensor
    columns: Tensor


def swept_edges_on_device(
    points: Tensor, displacements: Tensor, scene: Tensor, radius: float
) -> tuple[Tensor, Tensor]:
    """Return all pairs of particles of one scene that come within ``radius`` during a step.

    Parameters
    ----------
    points, displacements : (P, 3)
        Metres; particles move evenly from ``points`` to ``points + displacements``.
    scene : (P,)
        Number of the scene of each particle, int64.
    radius : float
        Metres.

    Returns
    -------
    receivers, senders : (E,)
        Both directions of each pair, int64, sorted by receiver, then sender.

    Raises
    ------
    BadInputError
        If the radius is not above 0, arrays do not fit each other, or a point is not finite.
    """
    _check(points, scene, radius)
    _check(displacements, scene, radius)
    if len(points) == 0:
        return scene.new_zeros(0), scene.new_zeros(0)
    points, displacements = points.double(), displacements.double()
    lengths = displacements.norm(dim=1)
    fast = (lengths > SLOW * radius).nonzero()[:, 0]
    slow = (lengths <= SLOW * radius).nonzero()[:, 0]
    found = []
    if len(slow):
        reach = (radius + float(lengths[slow].max())) * MARGIN
        middle = points[slow] + displacements[slow] / 2
        for first, second in _close_pairs(middle, scene[slow], reach, None):
            found.append(_that_meet(points, displacements, (slow[first], slow[second]), radius))
    if len(fast):
        found += _swept_by(fast, points, displacements, scene, radius, float(lengths.max()))
    return _sorted(found, len(points))


def _swept_by(
    fast: Tensor, points: Tensor, displacements: Tensor, scene: Tensor, radius: float,
    longest: float,
) -> list[tuple[Tensor, Tensor]]:  # fmt: skip
    """Return the swept pairs with a fast particle, in both directions, some of them repeatedly."""
    moments = min(math.ceil(2 * longest / radius), MOMENTS)
    reach = (radius + longest / moments) * MARGIN
    found = []
    for moment in range(moments):
        there = points + displacements * ((moment + 0.5) / moments)
        for pairs in _close_pairs(there, scene, reach, fast):
            first, second = _that_meet(points, displacements, pairs, radius)
            found += [(first, second), (second, first)]
    return found


def _that_meet(
    points: Tensor, displacements: Tensor, pairs: tuple[Tensor, Tensor], radius: float
) -> tuple[Tensor, Tensor]:
    """Return those of the pairs whose smallest distance in the step is at most the radius.

    The distance |d + s w| is smallest at s = min(max(-(d . w) / (w . w), 0), 1).
    """
    first, second = pairs
    d = points[second] - points[first]
    w = displacements[second] - displacements[first]
    squared = (w * w).sum(1)
    s = -(d * w).sum(1) / torch.where(squared == 0, torch.ones_like(squared), squared)
    closest = d + s.clamp(0, 1)[:, None] * w
    near = (closest * closest).sum(1) <= radius * radius
    return first[near], second[near]


def _close_pairs(
    points: Tensor, scene: Tensor, reach: float, queries: Tensor | None
) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield, in blocks, the pairs of a query and another particle of its scene within ``reach``.

    By default all particles are queries.
    """
    cells = _cells(points, scene, reach)
    own = torch.arange(len(points), device=points.device) if queries is None else queries
    middle = cells.numbers[own, None] + cells.columns
    low = torch.searchsorted(cells.ordered, middle - 1)
    counts = torch.searchsorted(cells.ordered, middle + 1, right=True) - low
    ends = counts.sum(1).cumsum(0)
    farthest, start = reach * reach, 0
    while start < len(own):
        done = int(ends[start - 1]) if start else 0
        stop = int(torch.searchsorted(ends, done + CANDIDATES_AT_ONCE, right=True))
        stop = max(stop, start + 1)
        rows = slice(start, stop)
        each = counts[rows].flatten()
        total = int(ends[stop - 1]) - done
        before = low[rows].flatten() - (each.cumsum(0) - each)
        row = torch.arange(total, device=points.device)
        second = cells.order[row + torch.repeat_interleave(before, each, output_size=total)]
        first = torch.repeat_interleave(own[rows], counts[rows].sum(1), output_size=total)
        apart = points.index_select(0, first).sub_(points.index_select(0, second))
        near = (apart.square_().sum(1) <= farthest) & (first != second)
        yield first[near], second[near]
        start = stop


def _cells(points: Tensor, scene: Tensor, reach: float) -> _Cells:
    """Return the cubes with edges of the reach, and the order of particles by cubes."""
    axes = torch.floor((points - points.amin(0)) / (reach * MARGIN)).long().unbind(1)
    number, cubes = _compressed(scene)
    columns = points.new_zeros(1, dtype=torch.int64)
    for axis, place in enumerate(axes):
        ranks, count = _compressed(place)
        # One cube is left free at both ends, so that those around a cube are never of another row.
        cubes *= count + 2
        number = number * (count + 2) + ranks + 1
        beside = torch.tensor([-1, 0, 1] if axis < 2 else [0], device=points.device)
        columns = (columns[:, None] * (count + 2) + beside).flatten()
    if cubes >= 1 << 62:
        raise BadInputError(f"{len(points)} particles lie too far apart: take fewer scenes at once")
    ordered, order = torch.sort(number)
    return _Cells(number, ordered, order, columns)


def _compressed(values: Tensor) -> tuple[Tensor, int]:
    """Return ranks of numbers, and how many: neighbours differ by 1 still, all others by 2.

    Products of the counts of the axes then fit in 64 bits, however far apart particles are.
    """
    known, places = torch.unique(values, return_inverse=True)
    steps = torch.ones_like(known)
    steps[0] = 0
    steps[1:] = known.diff().clamp(max=2)
    ranks = steps.cumsum(0)
    return ranks[places], int(ranks[-1]) + 1


def _sorted(pairs: list[tuple[Tensor, Tensor]], count: int) -> tuple[Tensor, Tensor]:
    """Return receivers and senders sorted, each pair once."""
    code = torch.unique(torch.cat([first * count + second for first, second in pairs]))
    return code // count, code % count


def _check(points: Tensor, scene: Tensor, radius: float) -> None:
    if not radius > 0 or points.shape != (len(scene), 3) or scene.dtype != torch.int64:
        raise BadInputError(
            "neighbours need a radius above 0 m, points (P, 3) and the number (P,) of the scene of "
            f"each, not {radius}, {tuple(points.shape)} and {tuple(scene.shape)} {scene.dtype}"
        )
    if not bool((points.abs() < MAX_METRES).all()):
        raise BadInputError(
            f"a particle has no finite position or one beyond {MAX_METRES:g} m: its motion diverged"
        )
