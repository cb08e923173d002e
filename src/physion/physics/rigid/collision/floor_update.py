"""Contact points of a hull and the floor in a step: moved along with the hull, or found anew.

See `physion.physics.rigid.collision.manifold` for the method. After PhysX 4 (``geomutils``):
``pcmContactPlaneConvex``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.collision.facing_faces import ClipSpace
from physion.physics.rigid.collision.hull_records import Hulls
from physion.physics.rigid.collision.manifold import Manifolds, refresh_points, set_direction
from physion.physics.rigid.collision.pair_distance import PairSpace
from physion.physics.rigid.collision.reduction import MANIFOLD_SIZE, spread_points

F64 = NDArray[np.float64]

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
