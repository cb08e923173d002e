"""Persistent contact manifolds: the contact points of a pair of hulls, kept from step to step.

A manifold holds up to four points, each as a point on hull A and one on hull B in the frames of
their bodies, with the normal from B to A in the frame of B. In every step:

1. `refresh_points` moves the points along with the bodies, and forgets those whose two halves have
   slid apart;
2. while nothing was forgotten and the pair has hardly moved (`has_moved`), these are the contacts;
3. otherwise the closest points are found anew and added (`add_point`);
4. if points were lost, or the new direction is more than 45 degrees from the old, all points are
   found anew from the faces.

`physion.physics.rigid.collision.pairs` goes through these steps, for two hulls and for a hull and
the floor.

So the contacts of a rolling or rocking body are partly older than the step, which delays and
smooths the change from one facet to the next.

After PhysX 4 (``geomutils``): ``PersistentContactManifold`` (``refreshContactPoints``,
``invalidate_BoxConvex``, ``addManifoldPoint``). Deviation: distances and depths are exact (PhysX
stops at 1.5 % of the distance, in single precision).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


# Choice of the four contact points that stand for all those of a pair of hulls.
#
# After PhysX 4 (``geomutils``): `spread_points` follows ``reduceBatchContacts``, `choose_of_five`
# ``reduceContactsForPCM``.

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


MOVED_FRACTIONS = np.array([0.5, 0.125, 0.25, 0.375, 0.375])
"""Parts of the smaller margin that a pair with 0 to 4 points may move before they are found anew
(PhysX)."""
ROTATED = np.array([0.9998, 0.9999, 0.9999, 0.9999, 0.9999])
"""Least scalar products of the orientations then and now with 0 to 4 points (PhysX)."""


class Manifolds(NamedTuple):
    """Manifolds of S pairs of geoms; all arrays are changed in place.

    - ``geoms`` (S, 2): geoms A < B of each pair; B is G for the floor.
    - ``size`` (S,): points. ``point_a``, ``point_b`` (S, 4, 3): metres, in the frame of each body.
      ``normal`` (S, 4, 3): unit, from B to A, in the frame of B. ``gap`` (S, 4): metres.
    - ``direction`` (S, 3): unit normal of the pair's contacts, from B to A, in the frame of B.
    - ``shift`` (S, 3), ``rotation`` (S, 2, 4): relative position and orientations of both bodies
      when points were last found.
    - ``corners`` (S,), ``corner`` (S, 4, 2): last simplex of the search for the closest points.
    - ``apart`` (S,): metres that the hulls were apart at least, when they were relatively at
      ``apart_rot`` (S, 3, 3), ``apart_shift`` (S, 3); 0 if unknown.
    - ``step`` (S,): last step in which the boxes of the pair overlapped.
    - ``touching`` (S,): the pair had contacts in its last step.
    - ``anchor_count`` (S,): friction anchors that held, 0 to 2. ``anchor`` (S, 2, 2, 3): anchors
      [pair, body, anchor, axis] and ``anchor_normal`` (S, 2, 3): normal, in the frames of both.
    """

    geoms: I64
    size: I64
    point_a: F64
    point_b: F64
    normal: F64
    gap: F64
    direction: F64
    shift: F64
    rotation: F64
    corners: I64
    corner: I64
    apart: F64
    apart_rot: F64
    apart_shift: F64
    step: I64
    touching: I64
    anchor_count: I64
    anchor: F64
    anchor_normal: F64


def new_manifolds(capacity: int) -> Manifolds:
    """Return room for the manifolds of ``capacity`` pairs."""
    return Manifolds(
        np.zeros((capacity, 2), np.int64),
        np.zeros(capacity, np.int64),
        np.zeros((capacity, 4, 3)),
        np.zeros((capacity, 4, 3)),
        np.zeros((capacity, 4, 3)),
        np.zeros((capacity, 4)),
        np.zeros((capacity, 3)),
        np.zeros((capacity, 3)),
        np.zeros((capacity, 2, 4)),
        np.zeros(capacity, np.int64),
        np.zeros((capacity, 4, 2), np.int64),
        np.zeros(capacity),
        np.zeros((capacity, 3, 3)),
        np.zeros((capacity, 3)),
        np.full(capacity, -2, np.int64),
        np.zeros(capacity, np.int64),
        np.zeros(capacity, np.int64),
        np.zeros((capacity, 2, 2, 3)),
        np.zeros((capacity, 2, 3)),
    )


def grown(manifolds: Manifolds, capacity: int) -> Manifolds:
    """Return the same manifolds with room for more."""
    larger = new_manifolds(capacity)
    for old, new in zip(manifolds, larger, strict=True):
        new[: len(old)] = old
    return larger


@in_place_kernel
def clear_manifold(manifolds: Manifolds, s: int) -> None:
    """Forget points, search start and friction anchors of pair ``s``.

    Where it was last searched is forgotten too: at the same place there would be no new search.
    """
    for i in range(3):
        manifolds.shift[s, i] = np.inf
    manifolds.size[s] = 0
    manifolds.corners[s] = 0
    manifolds.apart[s] = 0.0
    manifolds.touching[s] = 0
    manifolds.anchor_count[s] = 0


# With p_A, p_B the halves of a point in the frame of B and n its normal:
#     gap = (p_A - p_B) . n,      slide = |p_A - p_B - gap n|;  a point with slide > limit goes.


@in_place_kernel
def refresh_points(manifolds: Manifolds, s: int, rot: F64, shift: F64, limit: float) -> None:
    """Recompute the gaps of pair ``s``, and forget points that slid by more than ``limit`` metres.

    ``rot``, ``shift`` lead from the frame of A to that of B.
    """
    a, b, normal = manifolds.point_a, manifolds.point_b, manifolds.normal
    for k in range(manifolds.size[s] - 1, -1, -1):
        ax, ay, az = a[s, k, 0], a[s, k, 1], a[s, k, 2]
        dx = shift[0] + rot[0, 0] * ax + rot[0, 1] * ay + rot[0, 2] * az - b[s, k, 0]
        dy = shift[1] + rot[1, 0] * ax + rot[1, 1] * ay + rot[1, 2] * az - b[s, k, 1]
        dz = shift[2] + rot[2, 0] * ax + rot[2, 1] * ay + rot[2, 2] * az - b[s, k, 2]
        nx, ny, nz = normal[s, k, 0], normal[s, k, 1], normal[s, k, 2]
        gap = dx * nx + dy * ny + dz * nz
        dx, dy, dz = dx - gap * nx, dy - gap * ny, dz - gap * nz
        if dx * dx + dy * dy + dz * dz > limit * limit:
            last = manifolds.size[s] - 1
            manifolds.size[s] = last
            _copy_point(manifolds, s, last, k)
        else:
            manifolds.gap[s, k] = gap


@in_place_kernel
def _copy_point(manifolds: Manifolds, s: int, source: int, target: int) -> None:
    """Copy one point of pair ``s`` onto another."""
    for i in range(3):
        manifolds.point_a[s, target, i] = manifolds.point_a[s, source, i]
        manifolds.point_b[s, target, i] = manifolds.point_b[s, source, i]
        manifolds.normal[s, target, i] = manifolds.normal[s, source, i]
    manifolds.gap[s, target] = manifolds.gap[s, source]


@in_place_kernel
def has_moved(
    manifolds: Manifolds,
    s: int,
    shift: F64,
    qa: F64,
    qb: F64,
    margin: float,
    radius: float,
) -> bool:
    """Return whether pair ``s`` has moved too far since its points were found.

    That is: its relative position by more than a part of ``margin`` metres along an axis, or an
    orientation (4,) by a large angle, or by one that moves a point at ``radius`` metres by as much.
    As in PhysX, the angle is arccos(q . q'), which is half the rotation; for small angles
    arccos(c) = sqrt(2 (1 - c)).
    """
    count = manifolds.size[s]
    limit = margin * MOVED_FRACTIONS[count]
    for i in range(3):
        if abs(shift[i] - manifolds.shift[s, i]) > limit:
            return True
    for side in range(2):
        q = qa if side == 0 else qb
        cosine = 0.0
        for i in range(4):
            cosine += q[i] * manifolds.rotation[s, side, i]
        if cosine < ROTATED[count]:
            return True
        if cosine < 1.0 and np.sqrt(2.0 * (1.0 - cosine)) * radius > limit:
            return True
    return False


@in_place_kernel
def set_direction(manifolds: Manifolds, s: int) -> None:
    """Make the direction of pair ``s`` the unit mean of its normals; 0 without points."""
    x = y = z = 0.0
    for k in range(manifolds.size[s]):
        x += manifolds.normal[s, k, 0]
        y += manifolds.normal[s, k, 1]
        z += manifolds.normal[s, k, 2]
    length = np.sqrt(x * x + y * y + z * z)
    if length > 0.0:
        x, y, z = x / length, y / length, z / length
    direction = manifolds.direction
    direction[s, 0], direction[s, 1], direction[s, 2] = x, y, z


@in_place_kernel
def _set_point(manifolds: Manifolds, s: int, k: int, row: F64) -> None:
    """Make point ``k`` of pair ``s`` the row (10,): A, B, normal, gap."""
    for i in range(3):
        manifolds.point_a[s, k, i] = row[i]
        manifolds.point_b[s, k, i] = row[3 + i]
        manifolds.normal[s, k, i] = row[6 + i]
    manifolds.gap[s, k] = row[9]


@in_place_kernel
def add_point(
    manifolds: Manifolds, s: int, row: F64, replace: float, old: F64, chosen: I64
) -> None:
    """Add a point to pair ``s``; it replaces one that is closer than ``replace`` metres.

    ``row`` (10,): point in the frame of A, in that of B, normal, gap. With more than four points
    `choose_of_five` chooses. ``old`` (5, 10) and ``chosen`` (4,) are work space.
    """
    count = manifolds.size[s]
    for k in range(count):
        da = db = 0.0
        for i in range(3):
            da += (manifolds.point_a[s, k, i] - row[i]) ** 2
            db += (manifolds.point_b[s, k, i] - row[3 + i]) ** 2
        if min(da, db) < replace * replace:
            _set_point(manifolds, s, k, row)
            return
    if count < MANIFOLD_SIZE:
        _set_point(manifolds, s, count, row)
        manifolds.size[s] = count + 1
        return
    for k in range(MANIFOLD_SIZE):
        for i in range(3):
            old[k, i] = manifolds.point_a[s, k, i]
            old[k, 3 + i] = manifolds.point_b[s, k, i]
            old[k, 6 + i] = manifolds.normal[s, k, i]
        old[k, 9] = manifolds.gap[s, k]
    for i in range(10):
        old[4, i] = row[i]
    choose_of_five(old, chosen)
    for k in range(MANIFOLD_SIZE):
        _set_point(manifolds, s, k, old[chosen[k]])
