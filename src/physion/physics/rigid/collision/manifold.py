"""Persistent contact manifolds: the contact points of a pair of hulls, kept from step to step.

A manifold holds up to four points, each as a point on hull A and one on hull B in the frames of
their bodies, with the normal from B to A in the frame of B. In every step:

1. `refresh_points` moves the points along with the bodies, and forgets those whose two halves have
   slid apart;
2. while nothing was forgotten and the pair has hardly moved (`has_moved`), these are the contacts;
3. otherwise the closest points are found anew and added (`add_point`);
4. if points were lost, or the new direction is more than 45 degrees from the old, all points are
   found anew from the faces.

`physion.physics.rigid.collision.pair_update` goes through these steps for two hulls,
`floor_update` for a hull and the floor.

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
from physion.physics.rigid.collision.reduction import MANIFOLD_SIZE, choose_of_five

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

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
