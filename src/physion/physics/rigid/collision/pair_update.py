"""Contact points of a pair of hulls in a step: moved along with the bodies, or found anew.

See `physion.physics.rigid.collision.manifold` for the method. After PhysX 4 (``geomutils``):
``pcmContactConvexConvex``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.collision.closest_points import APART, OVERLAPPING
from physion.physics.rigid.collision.facing_faces import face_points
from physion.physics.rigid.collision.hull_records import Hulls
from physion.physics.rigid.collision.manifold import (
    Manifolds,
    add_point,
    has_moved,
    refresh_points,
    set_direction,
)
from physion.physics.rigid.collision.pair_distance import PairSpace, find_closest
from physion.physics.rigid.collision.reduction import MANIFOLD_SIZE, spread_points

F64 = NDArray[np.float64]

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
