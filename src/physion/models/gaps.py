"""Smallest gap of two bodies over a motion, between its frames too.

Bodies are compared by their convex pieces. If no point of them moves faster than s, their gap
changes by at most s a second. Over an interval of length h with the gaps g0 and g1 at its ends it
is at least (g0 + g1 - s h) / 2: intervals in which this is not below the smallest gap so far need
no closer look (Shubert 1972).

References
----------
B. O. Shubert, A sequential method seeking the global maximum of a function, SIAM Journal on
Numerical Analysis 9, 1972.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import norm
from physion.physics.rigid.bodies import collision_hulls
from physion.physics.rigid.collision.closest_points import (
    CLOSE,
    OVERLAPPING,
    Simplex,
    closest_points,
    new_simplex,
)
from physion.physics.rigid.collision.penetration import Polytope, new_polytope, penetration
from physion.scenes.scene import FRAME_TIME, Body

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

FAR = 10.0
"""Largest gap that is reported, metres; also the gap of an object that is absent."""
TOLERANCE = 1e-3
"""Metres by which the reported gap may exceed the smallest one."""


def minimise(gap: Callable[[float], float], top_speed: float, frames: int) -> float:
    """Return the minimum of a function of time over ``frames`` frames, to `TOLERANCE`.

    The search ends at the first value that is not above 0.

    Parameters
    ----------
    gap
        Function of the time in seconds, metres.
    top_speed
        Metres a second that its slope does not exceed.
    frames
        Length in frames; each is an interval at the start.
    """
    values: list[float] = []
    for frame in range(frames + 1):
        values.append(gap(frame * FRAME_TIME))
        if values[-1] <= 0:
            return values[-1]
    best = min(values)
    intervals = [
        (frame * FRAME_TIME, FRAME_TIME, *values[frame : frame + 2]) for frame in range(frames)
    ]
    while intervals and best > 0:
        start, length, first, last = intervals.pop()
        if (first + last - top_speed * length) / 2 >= best - TOLERANCE:
            continue
        half = length / 2
        middle = gap(start + half)
        best = min(best, middle)
        intervals += [(start, half, first, middle), (start + half, half, middle, last)]
    return best


def gap_of_bodies(
    bodies: Sequence[Body], centers: Sequence[F64]
) -> tuple[Callable[[F64, F64], float], list[float]]:
    """Return the gap of two bodies as a function of their relative pose, and their reaches.

    Parameters
    ----------
    bodies
        Two bodies, A and B.
    centers
        Points (3,) in the frames of the bodies, from which the relative pose is measured.

    Returns
    -------
    gap
        Function of the rotation (3, 3) and the shift (3,), metres, from the frame of A to the frame
        of B. It returns the smallest distance of their convex pieces, or minus the depth of the
        deepest overlap.
    reaches
        Largest distance of the points of each body from its center.
    """
    corners = [
        [hull.corners - center for hull in collision_hulls(body.shape, body.scale)]
        for body, center in zip(bodies, centers, strict=True)
    ]
    parts = [part for own in corners for part in own]
    vertices = np.ascontiguousarray(np.concatenate(parts), np.float64)
    ends = np.cumsum([0, *(len(part) for part in parts)]).astype(np.int64)
    pieces, simplex, polytope = len(corners[0]), new_simplex(), new_polytope()

    def gap(rotation: F64, shift: F64) -> float:
        return float(_signed_gap(vertices, ends, pieces, rotation, shift, simplex, polytope))

    return gap, [float(np.max(norm(np.concatenate(own)))) for own in corners]


@kernel
def _signed_gap(
    vertices: F64,
    ends: I64,
    pieces: int,
    rotation: F64,
    shift: F64,
    simplex: Simplex,
    polytope: Polytope,
) -> float:
    """Return the smallest distance of the convex pieces of two bodies, or minus the depth.

    Parameters
    ----------
    vertices : (V, 3)
        Corners of the pieces of A, then of B, each in the frame of its body, metres.
    ends : (K + 1,)
        Rows at which the pieces begin, and V. ``pieces``: how many of the K belong to A.
    rotation, shift : (3, 3), (3,)
        From the frame of A to the frame of B.
    simplex, polytope : Simplex, Polytope
        Work space.
    """
    smallest = np.inf
    span = np.empty(4, np.int64)
    found = np.empty(10)
    for i in range(pieces):
        for j in range(pieces, len(ends) - 1):
            span[0], span[1], span[2], span[3] = ends[i], ends[i + 1], ends[j], ends[j + 1]
            reach = max(smallest, 0.0)
            result, size, distance = closest_points(
                vertices, span, rotation, shift, reach, simplex, 0
            )
            if result == OVERLAPPING:
                depth = 0.0
                if penetration(vertices, span, rotation, shift, simplex, size, polytope, found):
                    depth = found[9]
                smallest = min(smallest, -depth)
            elif result == CLOSE:
                smallest = min(smallest, distance)
    return smallest
