"""Tests for overlap of bodies, and the height by which a body must be raised to avoid one.

A shape is represented by its convex pieces, as in collisions.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np

from physion.numerics.elementary import cos, sin, tan
from physion.numerics.linear_algebra import apply, inverse, multiply, norm
from physion.numerics.rotations import rotate_vectors
from physion.scenes.sampling.build import move_up
from physion.scenes.sampling.placement import world_bounds
from physion.scenes.scene import Body
from physion.scenes.shapes.meshes import Points
from physion.scenes.shapes.primitives import shape

GAP = 0.001
"""Gap left below a body that had to be raised, metres."""
TOUCH = 1e-6
"""Overlaps smaller than this (metres) count as touching."""
EXACT = 1e-12
"""Distances to a plane smaller than this (metres) are rounding errors."""
DEEP = 1e6
"""Depth (metres) of the three starting corners in `_rise`, below every body."""
MAX_EXCHANGES = 200


def _slope_grid() -> Points:
    angles = 2 * np.pi * np.arange(16) / 16
    slopes = tan(np.radians([0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 87.0, 89.5]))
    directions = np.stack([cos(angles), sin(angles)], axis=1)
    return np.asarray((slopes[:, None, None] * directions).reshape(-1, 2))


SLOPES = _slope_grid()
"""(K, 2): slopes along x and y, up to nearly upright."""


def raise_above(body: Body, obstacles: Sequence[Body]) -> Body:
    """Return the body, raised above all ``obstacles`` that it would start in or under."""
    rise = required_rise(body, obstacles)
    return move_up(body, rise + GAP) if rise > 0 else body


def required_rise(body: Body, obstacles: Sequence[Body]) -> float:
    """Return by how many metres ``body`` must rise until no obstacle is inside or above it."""
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
    """Return whether the bounding box of ``body`` in x and y overlaps none of theirs."""
    low, high = world_bounds(body)
    boxes = [world_bounds(other) for other in others]
    return all((high[:2] < b[0, :2]).any() or (low[:2] > b[1, :2]).any() for b in boxes)


def _corners(body: Body) -> list[Points]:
    """Return the corners (K, 3) of each convex piece in world coordinates."""
    offset = np.array(body.position)
    return [
        rotate_vectors(body.rotation, piece * body.scale) + offset
        for piece in _unit_corners(body.shape)
    ]


@cache
def _unit_corners(name: str) -> tuple[Points, ...]:
    return tuple(piece.mesh.vertices for piece in shape(name).pieces)


def _rough_rise(under: Points, part: Points) -> float:
    """Return an upper bound of the height by which ``part`` must rise to be above ``under``.

    Consider a plane z = u x + v y + c. It lies above all of ``under`` and below all of the risen
    ``part`` if the rise is max(z - u x - v y) over ``under`` plus max(u x + v y - z) over ``part``.
    The minimum over all slopes (u, v) is exact (`_rise`); over a grid of slopes it is a bound.
    """
    over = (under[:, 2:] - multiply(under[:, :2], SLOPES.T)).max(axis=0)
    return float((over + (multiply(part[:, :2], SLOPES.T) - part[:, 2:]).max(axis=0)).min())


def _rise(under: Points, part: Points) -> float:
    """Return the exact rise (see `_rough_rise`); minus infinity if the footprints do not overlap.

    The differences between points of ``under`` and points of ``part`` form a convex body, and the
    rise is the height at which the z axis leaves this body at the top. The simplex method finds
    it: three differences form a triangle around the axis; in each step one corner is exchanged for
    the difference farthest above the plane of the triangle, until none is above.
    """
    corners = np.array([[1.0, 0.0, -DEEP], [-0.5, 0.75, -DEEP], [-0.5, -0.75, -DEEP]])
    for _ in range(MAX_EXCHANGES):
        # Row i gives the barycentric weight of corner i at the point (x, y, 1); weights sum to 1.
        weights = inverse(np.vstack([corners[:, :2].T, np.ones(3)]))
        u, v, height = apply(weights.T, corners[:, 2])
        over = under[:, 2] - u * under[:, 0] - v * under[:, 1]
        below = part[:, 2] - u * part[:, 0] - v * part[:, 1]
        top, bottom = over.argmax(), below.argmin()
        rise = float(over[top] - below[bottom])
        if rise <= height + EXACT * norm((u, v, 1.0)):
            return -np.inf if (corners[:, 2] == -DEEP).any() else rise
        farthest = under[top] - part[bottom]
        step = apply(weights, (farthest[0], farthest[1], 1.0))
        # Exchange the corner whose weight at the origin reaches zero first.
        at_origin = np.maximum(weights[:, 2], 0.0)
        limits = np.divide(at_origin, step, out=np.full(3, np.inf), where=step > 1e-12)
        corners[limits.argmin()] = farthest
    return _rough_rise(under, part)
