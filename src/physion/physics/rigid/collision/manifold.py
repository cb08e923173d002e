"""Persistent contact manifolds: the contact points of a pair of hulls, kept from step to step.

A manifold holds up to four points, each as a point on hull A and one on hull B in the frames of
their bodies, with the normal from B to A in the frame of B. In every step:

1. `refresh_points` moves the points along with the bodies, and forgets those whose two halves have
   slid apart;
2. while nothing was forgotten and the pair has hardly moved (`keep_pair`), these are the contacts;
3. otherwise the closest points are found anew (`physion.physics.rigid.collision.closest_points`,
   or `penetration` where the hulls overlap) and added;
4. if points were lost, or the new direction is more than 45 degrees from the old, all points are
   found anew from the faces (`physion.physics.rigid.collision.clipping`).

So the contacts of a rolling or rocking body are partly older than the step, which delays and
smooths the change from one facet to the next.

After PhysX 4 (``geomutils``): ``PersistentContactManifold`` (``refreshContactPoints``,
``invalidate_BoxConvex``, ``addManifoldPoint``, ``reduceContactsForPCM``),
``pcmContactConvexConvex`` and ``pcmContactPlaneConvex``. Deviation: distances and depths are exact
(PhysX stops at 1.5 % of the distance, in single precision).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.collision.clipping import (
    MANIFOLD_SIZE,
    ClipSpace,
    face_points,
    new_clip_space,
    spread_points,
)
from physion.physics.rigid.collision.closest_points import (
    APART,
    CLOSE,
    OVERLAPPING,
    Simplex,
    closest_points,
    new_simplex,
)
from physion.physics.rigid.collision.hull_records import Hulls
from physion.physics.rigid.collision.penetration import Polytope, new_polytope, penetration

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

BREAK_FRACTION = 0.8
"""Part of the smaller margin by which the halves of a point may slide apart (PhysX)."""
FLOOR_FRACTION = 0.2
"""The same on the floor, where it is also the distance that a hull may move before its points are
found anew (PhysX)."""
REPLACE_FRACTION = 0.05
"""Part of the smaller margin within which a new point replaces an old one (PhysX)."""
MOVED_FRACTIONS = np.array([0.5, 0.125, 0.25, 0.375, 0.375])
"""Parts of the smaller margin that a pair with 0 to 4 points may move before they are found anew
(PhysX)."""
ROTATED = np.array([0.9998, 0.9999, 0.9999, 0.9999, 0.9999])
"""Least scalar products of the orientations then and now with 0 to 4 points (PhysX)."""
FLOOR_ROTATED = 0.9998
SAME_DIRECTION = 0.707106781
"""Cosine between old and new normals below which all points are found anew (PhysX)."""


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


class PairSpace(NamedTuple):
    """Work space of `update_pair`.

    ``rot`` (3, 3), ``shift`` (3,): from the frame of A to that of B. ``span`` (4,): vertices of A
    and B. ``closest`` (10,): direction from B to A, point of A, point of B, depth. ``old`` (5, 10):
    points that are being reduced: A, B, normal, gap. ``identity``, ``zero``: the frame of B.
    """

    simplex: Simplex
    polytope: Polytope
    clip: ClipSpace
    rot: F64
    shift: F64
    span: I64
    closest: F64
    old: F64
    identity: F64
    zero: F64


def new_pair_space() -> PairSpace:
    """Return the work space."""
    return PairSpace(
        new_simplex(),
        new_polytope(),
        new_clip_space(),
        np.zeros((3, 3)),
        np.zeros(3),
        np.zeros(4, np.int64),
        np.zeros(10),
        np.zeros((5, 10)),
        np.eye(3),
        np.zeros(3),
    )


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
    `_reduce_five` chooses. ``old`` (5, 10) and ``chosen`` (4,) are work space.
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
    _reduce_five(manifolds, s, old, chosen)


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
def _reduce_five(manifolds: Manifolds, s: int, p: F64, chosen: I64) -> None:
    """Keep four of the five points ``p`` (5, 10): the deepest, then those that span most.

    Of the last two, the one that is dropped still replaces its neighbour if it is deeper.
    ``chosen`` (4,) is work space.
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
    for k in range(4):
        _set_point(manifolds, s, k, p[chosen[k]])


@in_place_kernel
def _closest_row(space: PairSpace, row: F64) -> None:
    """Fill ``row`` (10,) with the closest points of ``space``: A, B, normal, gap."""
    rot, shift, closest = space.rot, space.shift, space.closest
    px, py, pz = closest[3] - shift[0], closest[4] - shift[1], closest[5] - shift[2]
    for i in range(3):
        row[i] = rot[0, i] * px + rot[1, i] * py + rot[2, i] * pz
        row[3 + i] = closest[6 + i]
        row[6 + i] = closest[i]
    row[9] = -closest[9]


@in_place_kernel
def find_closest(hulls: Hulls, manifolds: Manifolds, s: int, reach: float, space: PairSpace) -> int:
    """Find the closest points of pair ``s``.

    Returns `APART` beyond ``reach`` metres, `CLOSE` where they were found, and `OVERLAPPING` where
    the hulls overlap and the depth could not be computed.

    ``space.closest`` is filled: direction from B to A, points, depth (negative if apart).
    """
    g, h = manifolds.geoms[s, 0], manifolds.geoms[s, 1]
    simplex, span, closest = space.simplex, space.span, space.closest
    span[0], span[1] = hulls.first_vertex[g], hulls.first_vertex[g + 1]
    span[2], span[3] = hulls.first_vertex[h], hulls.first_vertex[h + 1]
    size = manifolds.corners[s]
    for k in range(size):
        simplex.corner[k, 0] = manifolds.corner[s, k, 0]
        simplex.corner[k, 1] = manifolds.corner[s, k, 1]
    result, size, distance = closest_points(
        hulls.vertices, span, space.rot, space.shift, reach, simplex, size
    )
    # A full simplex holds the origin: it is of no use once the hulls have parted.
    manifolds.corners[s] = size if size < 4 else 0
    for k in range(size):
        manifolds.corner[s, k, 0] = simplex.corner[k, 0]
        manifolds.corner[s, k, 1] = simplex.corner[k, 1]
    if result == APART:
        manifolds.apart[s] = distance
        for i in range(3):
            manifolds.apart_shift[s, i] = space.shift[i]
            for j in range(3):
                manifolds.apart_rot[s, i, j] = space.rot[i, j]
        return APART
    if result == CLOSE:
        for i in range(3):
            closest[i] = simplex.closest[i] / distance
            closest[3 + i] = 0.0
            closest[6 + i] = 0.0
            for k in range(size):
                closest[3 + i] += simplex.weight[k] * simplex.point[k, 3 + i]
                closest[6 + i] += simplex.weight[k] * simplex.point[k, 6 + i]
        closest[9] = -distance
        return CLOSE
    if penetration(
        hulls.vertices, span, space.rot, space.shift, simplex, size, space.polytope, closest
    ):
        return CLOSE
    return OVERLAPPING


# Between two poses, a corner p of A moves in the frame of B by (R - R') p + t - t', that is by at
# most |R - R'| |p| + |t - t'|, with the Frobenius norm of the matrix.


@in_place_kernel
def still_apart(
    manifolds: Manifolds, s: int, rot: F64, shift: F64, extent: float, reach: float
) -> bool:
    """Return whether pair ``s`` is sure to be farther apart than ``reach`` metres.

    ``rot``, ``shift`` lead from the frame of A to that of B; ``extent`` is the largest distance of
    a corner of A from the origin of its frame.
    """
    apart = manifolds.apart[s]
    if apart <= reach:
        return False
    moved = turned = 0.0
    for i in range(3):
        moved += (shift[i] - manifolds.apart_shift[s, i]) ** 2
        for j in range(3):
            turned += (rot[i, j] - manifolds.apart_rot[s, i, j]) ** 2
    return bool(apart - np.sqrt(moved) - np.sqrt(turned) * extent > reach)


@in_place_kernel
def keep_pair(
    hulls: Hulls, manifolds: Manifolds, s: int, rot: F64, shift: F64, qa: F64, qb: F64
) -> bool:
    """Move the points of pair ``s`` along; return whether they still describe it.

    Otherwise `update_pair` has to find points anew. ``rot``, ``shift`` lead from the frame of A to
    that of B; ``qa``, ``qb`` (4,) are the orientations of both bodies.
    """
    g, h = manifolds.geoms[s, 0], manifolds.geoms[s, 1]
    margin = min(hulls.margin[g], hulls.margin[h])
    before = manifolds.size[s]
    refresh_points(manifolds, s, rot, shift, BREAK_FRACTION * margin)
    # PhysX takes the radius of the first hull for both.
    if manifolds.size[s] != before or has_moved(
        manifolds, s, shift, qa, qb, margin, hulls.radius[g]
    ):
        return False
    set_direction(manifolds, s)
    return True


@in_place_kernel
def update_pair(
    hulls: Hulls,
    manifolds: Manifolds,
    s: int,
    qa: F64,
    qb: F64,
    before: int,
    reach: float,
    space: PairSpace,
) -> int:
    """Find points of pair ``s`` anew: the closest ones, and all where too many were lost.

    Parameters
    ----------
    hulls, manifolds, s
        All hulls, all manifolds, and the pair.
    qa, qb : (4,)
        Orientations of both bodies.
    before : int
        Points before those were lost that slid too far; -1 to find all anew.
    reach : float
        Metres between surfaces below which points are contacts.
    space : PairSpace
        Work space; its ``rot`` and ``shift`` are those of the pair.

    Returns
    -------
    int
        Number of points; those with a gap above ``reach`` are not contacts. Old points stay where
        an overlap has no computable depth.
    """
    g, h = manifolds.geoms[s, 0], manifolds.geoms[s, 1]
    margin = min(hulls.margin[g], hulls.margin[h])
    if before < 0:
        manifolds.size[s] = 0
    for i in range(3):
        manifolds.shift[s, i] = space.shift[i]
    for i in range(4):
        manifolds.rotation[s, 0, i] = qa[i]
        manifolds.rotation[s, 1, i] = qb[i]
    result = find_closest(hulls, manifolds, s, reach, space)
    if result == APART:
        return 0
    if result == OVERLAPPING:
        set_direction(manifolds, s)
        return int(manifolds.size[s])
    closest, direction = space.closest, manifolds.direction
    set_direction(manifolds, s)
    cosine = 0.0
    for i in range(3):
        cosine += direction[s, i] * closest[i]
    row = space.old[4]
    _closest_row(space, row)
    add_point(manifolds, s, row, REPLACE_FRACTION * margin, space.old, space.clip.chosen)
    if before >= 0 and cosine >= SAME_DIRECTION and manifolds.size[s] >= before:
        # The new direction counts as much as all old ones together (PhysX).
        squared = 0.0
        for i in range(3):
            direction[s, i] += closest[i]
            squared += direction[s, i] ** 2
        for i in range(3):
            direction[s, i] /= np.sqrt(squared)
        return int(manifolds.size[s])
    _points_of_faces(hulls, manifolds, s, reach, space)
    set_direction(manifolds, s)
    return int(manifolds.size[s])


@in_place_kernel
def _points_of_faces(
    hulls: Hulls, manifolds: Manifolds, s: int, reach: float, space: PairSpace
) -> None:
    """Replace the points of pair ``s`` by those of the facing faces, if these overlap."""
    clip, closest, rot, shift = space.clip, space.closest, space.rot, space.shift
    count = face_points(
        hulls,
        manifolds.geoms[s, 0],
        manifolds.geoms[s, 1],
        rot,
        shift,
        closest[0:3],
        closest[3:6],
        closest[6:9],
        reach,
        space.identity,
        space.zero,
        clip,
    )
    if count == 0:
        return
    if count > MANIFOLD_SIZE:
        spread_points(clip.points, count, clip.normal, clip.chosen)
        count = MANIFOLD_SIZE
    else:
        for k in range(count):
            clip.chosen[k] = k
    for k in range(count):
        c = clip.chosen[k]
        px, py, pz = (
            clip.points[c, 0] - shift[0],
            clip.points[c, 1] - shift[1],
            clip.points[c, 2] - shift[2],
        )
        for i in range(3):
            manifolds.point_a[s, k, i] = rot[0, i] * px + rot[1, i] * py + rot[2, i] * pz
            manifolds.point_b[s, k, i] = clip.points[c, 3 + i]
            manifolds.normal[s, k, i] = clip.normal[i]
        manifolds.gap[s, k] = clip.points[c, 6]
    manifolds.size[s] = count


@in_place_kernel
def update_floor(
    hulls: Hulls,
    manifolds: Manifolds,
    s: int,
    qa: F64,
    reach: float,
    floor: float,
    persistent: bool,
    space: PairSpace,
) -> int:
    """Bring the manifold of a hull and the floor up to the hull's present pose.

    The floor is the plane z = ``floor`` metres; B is the world, so ``space.rot`` and ``shift`` are
    the pose of the hull. Contacts are corners lower than ``reach`` above it. Returns the number of
    points; the normal is z.
    """
    g = manifolds.geoms[s, 0]
    rot, shift = space.rot, space.shift
    limit = FLOOR_FRACTION * hulls.margin[g]
    if persistent:
        before = manifolds.size[s]
        refresh_points(manifolds, s, rot, shift, limit)
        moved = manifolds.size[s] != before
        cosine = 0.0
        for i in range(4):
            cosine += qa[i] * manifolds.rotation[s, 0, i]
        moved = moved or cosine < FLOOR_ROTATED
        for i in range(3):
            moved = moved or abs(shift[i] - manifolds.shift[s, i]) > limit
        if not moved:
            set_direction(manifolds, s)
            return int(manifolds.size[s])
    for i in range(3):
        manifolds.shift[s, i] = shift[i]
    for i in range(4):
        manifolds.rotation[s, 0, i] = qa[i]
    clip = space.clip
    clip.normal[0], clip.normal[1], clip.normal[2] = 0.0, 0.0, 1.0
    points = clip.points
    count = 0
    for v in range(hulls.first_vertex[g], hulls.first_vertex[g + 1]):
        px, py, pz = hulls.vertices[v, 0], hulls.vertices[v, 1], hulls.vertices[v, 2]
        z = shift[2] + rot[2, 0] * px + rot[2, 1] * py + rot[2, 2] * pz
        if z - floor >= reach:
            continue
        if count == len(points):
            count = _keep_four(clip, count)
        points[count, 0], points[count, 1], points[count, 2] = px, py, pz
        points[count, 3] = shift[0] + rot[0, 0] * px + rot[0, 1] * py + rot[0, 2] * pz
        points[count, 4] = shift[1] + rot[1, 0] * px + rot[1, 1] * py + rot[1, 2] * pz
        points[count, 5] = floor
        points[count, 6] = z - floor
        count += 1
    if count > MANIFOLD_SIZE:
        count = _keep_four(clip, count)
    for k in range(count):
        for i in range(3):
            manifolds.point_a[s, k, i] = points[k, i]
            manifolds.point_b[s, k, i] = points[k, 3 + i]
            manifolds.normal[s, k, i] = clip.normal[i]
        manifolds.gap[s, k] = points[k, 6]
    manifolds.size[s] = count
    set_direction(manifolds, s)
    return count


@in_place_kernel
def _keep_four(clip: ClipSpace, count: int) -> int:
    """Move the four points that stand for all to the front of ``clip.points``; return 4."""
    spread_points(clip.points, count, clip.normal, clip.chosen)
    kept = clip.kept
    for k in range(MANIFOLD_SIZE):
        for i in range(7):
            kept[k, i] = clip.points[clip.chosen[k], i]
    for k in range(MANIFOLD_SIZE):
        for i in range(7):
            clip.points[k, i] = kept[k, i]
    return MANIFOLD_SIZE
