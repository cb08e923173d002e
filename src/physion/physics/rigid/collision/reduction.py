"""Choice of the four contact points that stand for all those of a pair of hulls.

After PhysX 4 (``geomutils``): `spread_points` follows ``reduceBatchContacts``, `choose_of_five`
``reduceContactsForPCM``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MANIFOLD_SIZE = 4
"""Points kept of a pair of convex hulls (PhysX)."""
FAR = 0.02
"""Metres: where some points of a manifold are closer and others farther than this, far points give
way to close ones (PhysX: 2 % of its length scale)."""


# Reduction to four points that span the manifold: a, the deepest; b, the farthest from a; then,
# with s the direction across a-b in the contact plane, the points with the largest and with the
# smallest s . (p - a); if both lie on one side, the two largest.


@in_place_kernel
def spread_points(points: F64, count: int, normal: F64, chosen: I64) -> None:
    """Fill ``chosen`` (4,) with the rows of four points that stand for all.

    ``points`` (K, 7) are point of A, point of B and gap, ``count`` > 4 of them; ``normal`` (3,) is
    theirs.
    """
    deepest = 0
    farthest_gap = -np.inf
    for i in range(count):
        if points[i, 6] < points[deepest, 6]:
            deepest = i
        farthest_gap = max(farthest_gap, points[i, 6])
    best = -1.0
    second = 0
    for i in range(count):
        if i == deepest:
            continue
        d = 0.0
        for k in range(3, 6):
            d += (points[i, k] - points[deepest, k]) ** 2
        if d > best:
            best = d
            second = i
    ex, ey, ez = (
        points[second, 3] - points[deepest, 3],
        points[second, 4] - points[deepest, 4],
        points[second, 5] - points[deepest, 5],
    )
    sx = ey * normal[2] - ez * normal[1]
    sy = ez * normal[0] - ex * normal[2]
    sz = ex * normal[1] - ey * normal[0]
    if sx * sx + sy * sy + sz * sz == 0.0:
        sx, sy, sz = normal[0], normal[1], normal[2]
    high, low = -1, -1
    largest, smallest = -np.inf, np.inf
    for i in range(count):
        if i in (deepest, second):
            continue
        across = (
            (points[i, 3] - points[deepest, 3]) * sx
            + (points[i, 4] - points[deepest, 4]) * sy
            + (points[i, 5] - points[deepest, 5]) * sz
        )
        if across > largest:
            largest = across
            high = i
        if across < smallest:
            smallest = across
            low = i
    if largest * smallest > 0.0 or low == high:
        again = -np.inf
        for i in range(count):
            if i in (deepest, second, high):
                continue
            across = (
                (points[i, 3] - points[deepest, 3]) * sx
                + (points[i, 4] - points[deepest, 4]) * sy
                + (points[i, 5] - points[deepest, 5]) * sz
            )
            if across > again:
                again = across
                low = i
    chosen[0], chosen[1], chosen[2], chosen[3] = deepest, second, high, low
    if not points[deepest, 6] < FAR < farthest_gap:
        return
    for k in range(MANIFOLD_SIZE):
        gap = points[chosen[k], 6]
        if gap <= FAR:
            continue
        swap = -1
        for i in range(count):
            taken = i in (chosen[0], chosen[1], chosen[2], chosen[3])
            if not taken and points[i, 6] < gap and points[i, 6] < FAR:
                gap = points[i, 6]
                swap = i
        if swap >= 0:
            chosen[k] = swap


@in_place_kernel
def _to_segment(p: F64, k: int, a: int, b: int) -> float:
    """Return the squared distance of point ``k`` from the segment of points a and b, on hull B."""
    along = length = 0.0
    for i in range(3, 6):
        edge = p[b, i] - p[a, i]
        along += (p[k, i] - p[a, i]) * edge
        length += edge * edge
    t = min(max(along / length, 0.0), 1.0) if length > 0.0 else 0.0
    total = 0.0
    for i in range(3, 6):
        total += (p[k, i] - p[a, i] - t * (p[b, i] - p[a, i])) ** 2
    return total


@in_place_kernel
def _outside_triangle(p: F64, k: int, a: int, b: int, c: int) -> float:
    """Return the squared distance of point ``k`` from triangle a-b-c, on hull B.

    A point over the inside has its height over the plane.
    """
    ux, uy, uz = p[b, 3] - p[a, 3], p[b, 4] - p[a, 4], p[b, 5] - p[a, 5]
    vx, vy, vz = p[c, 3] - p[a, 3], p[c, 4] - p[a, 4], p[c, 5] - p[a, 5]
    wx, wy, wz = p[k, 3] - p[a, 3], p[k, 4] - p[a, 4], p[k, 5] - p[a, 5]
    uu, uv, vv = (
        ux * ux + uy * uy + uz * uz,
        ux * vx + uy * vy + uz * vz,
        vx * vx + vy * vy + vz * vz,
    )
    wu, wv = wx * ux + wy * uy + wz * uz, wx * vx + wy * vy + wz * vz
    area = uu * vv - uv * uv
    if area > 0.0:
        s = (wu * vv - wv * uv) / area
        t = (wv * uu - wu * uv) / area
        if s >= 0.0 and t >= 0.0 and s + t <= 1.0:
            hx = wx - s * ux - t * vx
            hy = wy - s * uy - t * vy
            hz = wz - s * uz - t * vz
            return float(hx * hx + hy * hy + hz * hz)
    return float(
        min(_to_segment(p, k, a, b), min(_to_segment(p, k, a, c), _to_segment(p, k, b, c)))
    )


@in_place_kernel
def choose_of_five(p: F64, chosen: I64) -> None:
    """Fill ``chosen`` (4,) with rows of ``p``: the deepest point, then those that span most.

    ``p`` (5, 10) are points on A, on B, normals and gaps. The point that is left out still replaces
    its nearest neighbour if it is deeper.
    """
    deepest = 4
    for k in range(4):
        if p[k, 9] < p[deepest, 9]:
            deepest = k
    chosen[0] = deepest
    best = -1.0
    for k in range(5):
        if k != deepest:
            d = 0.0
            for i in range(3, 6):
                d += (p[k, i] - p[deepest, i]) ** 2
            if d > best:
                best = d
                chosen[1] = k
    best = -1.0
    for k in range(5):
        if k not in (chosen[0], chosen[1]):
            d = _to_segment(p, k, chosen[0], chosen[1])
            if d > best:
                best = d
                chosen[2] = k
    best = -1.0
    for k in range(5):
        if k not in (chosen[0], chosen[1], chosen[2]):
            d = _outside_triangle(p, k, chosen[0], chosen[1], chosen[2])
            if d > best:
                best = d
                chosen[3] = k
    dropped = 10 - chosen[0] - chosen[1] - chosen[2] - chosen[3]
    nearest = 0
    best = np.inf
    for k in range(4):
        d = 0.0
        for i in range(3):
            d += (p[chosen[k], i] - p[dropped, i]) ** 2
        if d < best:
            best = d
            nearest = k
    if p[chosen[nearest], 9] > p[dropped, 9]:
        chosen[nearest] = dropped
