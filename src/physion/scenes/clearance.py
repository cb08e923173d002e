"""Whether bodies are free of one another, and how far one must rise to be.

Both by the convex pieces that stand for shapes in contacts.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from scipy.optimize import linprog

from physion.scenes.placement import rotate, world_bounds
from physion.scenes.scene import Body
from physion.scenes.shapes import shape
from physion.scenes.solids import Points
from physion.scenes.stage import raised

GAP = 0.001
"""Metres left free where a body had to be raised off another one."""
TOUCH = 1e-6
"""Metres: bodies that overlap by less only touch."""


def _slope_grid() -> Points:
    turns = 2 * np.pi * np.arange(16) / 16
    tilts = np.tan(np.radians([0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 87.0, 89.5]))
    ways = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    return np.asarray((tilts[:, None, None] * ways).reshape(-1, 2))


SLOPES = _slope_grid()
"""(K, 2): slopes along x and y, up to nearly upright."""


def cleared(body: Body, obstacles: Sequence[Body]) -> Body:
    """The body, raised above every one of ``obstacles`` that it would start in or under."""
    rise = needed_rise(body, obstacles)
    return raised(body, rise + GAP) if rise > 0 else body  # type: ignore[no-any-return]


def needed_rise(body: Body, obstacles: Sequence[Body]) -> float:
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


def beside(body: Body, others: Sequence[Body]) -> bool:
    """Whether the level rectangle round ``body`` is free of those round ``others``."""
    low, high = world_bounds(body)
    boxes = [world_bounds(other) for other in others]
    return all((high[:2] < b[0, :2]).any() or (low[:2] > b[1, :2]).any() for b in boxes)


def _corners(body: Body) -> list[Points]:
    """World corners (K, 3) of each convex piece."""
    place = np.array(body.position)
    return [
        rotate(body.rotation, piece * body.scale) + place for piece in _unit_corners(body.shape)
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
    over = (under[:, 2:] - under[:, :2] @ SLOPES.T).max(axis=0)
    return float((over + (part[:, :2] @ SLOPES.T - part[:, 2:]).max(axis=0)).min())


def _rise(under: Points, part: Points) -> float:
    """The least over all slopes, by a linear program; minus infinity where no rise is needed."""
    one, none = np.ones((len(under), 1)), np.zeros((len(under), 1))
    other, nought = np.ones((len(part), 1)), np.zeros((len(part), 1))
    rows = np.vstack(
        [
            np.hstack([-under[:, :2], -one, none]),
            np.hstack([part[:, :2], nought, -other]),
        ]
    )
    limits = np.concatenate([-under[:, 2], part[:, 2]])
    found = linprog([0, 0, 1, 1], A_ub=rows, b_ub=limits, bounds=(None, None), method="highs")
    # Without a bound below, the two are beside each other.
    return float(found.fun) if found.status == 0 else -np.inf
