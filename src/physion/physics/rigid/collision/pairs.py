"""Contact points of two hulls, or of a hull and the floor: moved with the bodies, or found anew.

See `physion.physics.rigid.collision.manifold` for the method. After PhysX 4 (``geomutils``):
``pcmContactConvexConvex`` and, for the floor, ``pcmContactPlaneConvex``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.collision.closest_points import (
    APART,
    CLOSE,
    OVERLAPPING,
    Simplex,
    closest_points,
    fill_closest,
    new_simplex,
)
from physion.physics.rigid.collision.faces import ClipSpace, Hulls, face_points, new_clip_space
from physion.physics.rigid.collision.manifold import (
    MANIFOLD_SIZE,
    Manifolds,
    add_point,
    has_moved,
    refresh_points,
    set_direction,
    spread_points,
)
from physion.physics.rigid.collision.penetration import Polytope, new_polytope, penetration

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


# Closest points of a pair of hulls, and a bound on how far they still are apart.


class PairSpace(NamedTuple):
    """Work space of the search for the contact points of a pair.

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
        fill_closest(simplex, size, distance, closest)
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


BREAK_FRACTION = 0.8
"""Part of the smaller margin by which the halves of a point may slide apart (PhysX)."""
REPLACE_FRACTION = 0.05
"""Part of the smaller margin within which a new point replaces an old one (PhysX)."""
SAME_DIRECTION = 0.707106781
"""Cosine between old and new normals below which all points are found anew (PhysX)."""


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


# Contact points of a hull and the floor.

FLOOR_FRACTION = 0.2
"""Part of the hull's margin by which the halves of a point may slide apart, and the hull may move,
before its points are found anew (PhysX)."""
FLOOR_ROTATED = 0.9998
"""Least scalar product of the orientations then and now (PhysX)."""


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
