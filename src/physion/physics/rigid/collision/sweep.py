"""Time of impact of two hulls that move without rotating, by conservative advancement.

Hull A moves by m in a step, seen from B, and B stands still. With d the distance of the hulls and n
the unit direction from B to A of their closest points, A comes nearer along n by -m . n a step, and
B lies behind the plane through its closest point: no hit is possible before a further

    d / (-m . n)

of the step. A is advanced by this time, to half of `gap`, until the hulls are no farther apart than
``gap``, or move apart (-m . n <= 0), or the step is over.

References
----------
B. Mirtich, Impulse-based dynamic simulation of rigid body systems, PhD thesis, University of
California, Berkeley, 1996, section 2.3 (conservative advancement).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.collision.closest_points import OVERLAPPING, closest_points, fill_closest
from physion.physics.rigid.collision.faces import Hulls
from physion.physics.rigid.collision.pairs import PairSpace
from physion.physics.rigid.collision.penetration import penetration

F64 = NDArray[np.float64]

MAX_ADVANCES = 64
"""Advances before the hulls count as touching. Two or three are usual."""
GAP_FRACTION = 0.01
"""Part of the smaller margin of two hulls at which they count as touching (PhysX: .1 of the
``sweepMargin``, which is a tenth of the margin)."""


@in_place_kernel
def time_of_impact(
    hulls: Hulls, g: int, h: int, motion: F64, latest: float, space: PairSpace
) -> float:
    """Return the part of the motion after which hulls ``g`` (A) and ``h`` (B) touch.

    Parameters
    ----------
    hulls : Hulls
        All hulls.
    g, h : int
        Rows of A and B.
    motion : (3,)
        How A moves, metres, in the frame of B.
    latest : float
        Hits at this time or later are not asked for; at most 1.
    space : PairSpace
        ``rot`` and ``shift`` are the pose of A in the frame of B at the start; ``shift`` is changed
        to that at the impact. ``closest`` is filled as by `find_closest`: direction from B to A,
        points, depth, which is above 0 where the hulls overlap at the start.

    Returns
    -------
    float
        0 to ``latest``; infinity without an impact.
    """
    simplex, span, shift, closest = space.simplex, space.span, space.shift, space.closest
    span[0], span[1] = hulls.first_vertex[g], hulls.first_vertex[g + 1]
    span[2], span[3] = hulls.first_vertex[h], hulls.first_vertex[h + 1]
    gap = GAP_FRACTION * min(hulls.margin[g], hulls.margin[h])
    time = 0.0
    size = 0
    for _ in range(MAX_ADVANCES):
        result, size, distance = closest_points(
            hulls.vertices, span, space.rot, shift, np.inf, simplex, size
        )
        if result == OVERLAPPING:
            if time == 0.0:
                _fill_overlap(hulls, motion, size, space)
            return time
        fill_closest(simplex, size, distance, closest)
        if distance <= gap:
            return time
        nearing = -(closest[0] * motion[0] + closest[1] * motion[1] + closest[2] * motion[2])
        if nearing <= 0.0:
            return np.inf
        advance = (distance - 0.5 * gap) / nearing
        time += advance
        if time >= latest:
            return np.inf
        for i in range(3):
            shift[i] += advance * motion[i]
    return time


@in_place_kernel
def _fill_overlap(hulls: Hulls, motion: F64, size: int, space: PairSpace) -> None:
    """Fill ``space.closest`` for hulls that overlap at the start of their motion.

    Where no depth can be computed, it is 0 and the direction is that against the motion.
    """
    closest = space.closest
    if penetration(
        hulls.vertices, space.span, space.rot, space.shift, space.simplex, size, space.polytope,
        closest,
    ):  # fmt: skip
        return
    length = np.sqrt(motion[0] ** 2 + motion[1] ** 2 + motion[2] ** 2)
    for i in range(3):
        closest[i] = -motion[i] / length
        closest[3 + i] = space.shift[i]
        closest[6 + i] = space.shift[i]
    closest[9] = 0.0
