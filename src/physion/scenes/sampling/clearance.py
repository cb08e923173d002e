"""Whether bodies are free of one another, and how far one must rise to be.

Both by the convex pieces that stand for shapes in contacts.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from physion.numerics.elementary import cos, sin, tan
from physion.numerics.linear_algebra import apply, inverse, multiply, norm
from physion.numerics.rotations import rotate_vectors
from physion.scenes.sampling.build import raised
from physion.scenes.sampling.placement import world_bounds
from physion.scenes.scene import Body
from physion.scenes.shapes.meshes import Points
from physion.scenes.shapes.primitives import shape

GAP = 0.001
"""Metres left free where a body had to be raised off another one."""
TOUCH = 1e-6
"""Metres: bodies that overlap by less only touch."""
EXACT = 1e-12
"""Metres above a plane, at right angles to it, that count as nothing: rounding."""
DEEP = 1e6
"""Metres below everything; walls with a slope of more than this count as upright."""
MOST_EXCHANGES = 200


def _slope_grid() -> Points:
    angles = 2 * np.pi * np.arange(16) / 16
    tilts = tan(np.radians([0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 87.0, 89.5]))
    ways = np.stack([cos(angles), sin(angles)], axis=1)
    return np.asarray((tilts[:, None, None] * ways).reshape(-1, 2))


SLOPES = _slope_grid()
"""(K, 2): slopes along x and y, up to nearly upright."""


def raised_clear_of(body: Body, obstacles: Sequence[Body]) -> Body:
    """The body, raised above every one of ``obstacles`` that it would start in or under."""
    rise = required_rise(body, obstacles)
    return raised(body, rise + GAP) if rise > 0 else body  # type: ignore[no-any-return]


def required_rise(body: Body, obstacles: Sequence[Body]) -> float:
    """Metres by which ``body`` must rise until nothing of ``obstacles`` is in or above it."""
    (x0, y0, bottom), (x1, y1, _) = world_bounds(body)
    parts = _corners(body)
    pairs = []
    for obstacle in obstacles:
        low, high = world_bounds(obstacle)
        if high[2] <= bottom + TOUCH or high[0] <= x0 or high[1] <= y0:
            continue
        if low[0] >= x1 or low[1] >= y1:
            continue
        pairs += [(_rough_rise(u, part), u, part) for u in _corners(obstacle) for part in parts]
    need = 0.0
    for rough, under, part in sorted(pairs, key=lambda pair: -pair[0]):
        if rough <= need + TOUCH:
            break
        need = max(need, _rise(under, part))
    return need


def is_clear_of(body: Body, others: Sequence[Body]) -> bool:
    """Whether the level rectangle round ``body`` is free of those round ``others``."""
    low, high = world_bounds(body)
    boxes = [world_bounds(other) for other in others]
    return all((high[:2] < b[0, :2]).any() or (low[:2] > b[1, :2]).any() for b in boxes)


def _corners(body: Body) -> list[Points]:
    """World corners (K, 3) of each convex piece."""
    offset = np.array(body.position)
    return [
        rotate_vectors(body.rotation, piece * body.scale) + offset
        for piece in _unit_corners(body.shape)
    ]


@cache
def _unit_corners(name: str) -> tuple[Points, ...]:
    return tuple(piece.mesh.vertices for piece in shape(name).pieces)


def _rough_rise(under: Points, part: Points) -> float:
    """How far a convex ``part`` must rise to be above ``under``, or somewhat more.

    A plane z = ux + vy + c above all of ``under`` is below all of the part once that has risen by
    max(z - ux - vy) of the one plus max(ux + vy - z) of the other. The least over all slopes (u, v)
    is the answer; that over a few slopes is on the safe side.
    """
    over = (under[:, 2:] - multiply(under[:, :2], SLOPES.T)).max(axis=0)
    return float((over + (multiply(part[:, :2], SLOPES.T) - part[:, 2:]).max(axis=0)).min())


def _rise(under: Points, part: Points) -> float:
    """Find that least rise over all slopes; minus infinity where the two are beside each other.

    The differences between points of ``under`` and of ``part`` fill a convex body, and the answer
    is the height at which the upright line through the origin leaves it. The simplex method finds
    it: of three differences that surround the line, one gives way to that difference which is
    farthest above the plane through them, until none is above.
    """
    corners = np.array([[1.0, 0.0, -DEEP], [-0.5, 0.75, -DEEP], [-0.5, -0.75, -DEEP]])
    for _ in range(MOST_EXCHANGES):
        # Row i gives the share of corner i in a level place (x, y, 1), so that shares add up to 1.
        shares = inverse(np.vstack([corners[:, :2].T, np.ones(3)]))
        u, v, height = apply(shares.T, corners[:, 2])
        over = under[:, 2] - u * under[:, 0] - v * under[:, 1]
        below = part[:, 2] - u * part[:, 0] - v * part[:, 1]
        top, bottom = over.argmax(), below.argmin()
        rise = float(over[top] - below[bottom])
        if rise <= height + EXACT * norm((u, v, 1.0)):
            return -np.inf if (corners[:, 2] == -DEEP).any() else rise
        found = under[top] - part[bottom]
        step = apply(shares, (found[0], found[1], 1.0))
        # The corner whose share of the origin is the first to be used up.
        here = np.maximum(shares[:, 2], 0.0)
        limits = np.divide(here, step, out=np.full(3, np.inf), where=step > 1e-12)
        corners[limits.argmin()] = found
    return _rough_rise(under, part)
