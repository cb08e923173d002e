"""Closest points of a pair of hulls, and a bound on how far they still are apart."""

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
from physion.physics.rigid.collision.facing_faces import ClipSpace, new_clip_space
from physion.physics.rigid.collision.hull_records import Hulls
from physion.physics.rigid.collision.manifold import Manifolds
from physion.physics.rigid.collision.penetration import Polytope, new_polytope, penetration

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


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
