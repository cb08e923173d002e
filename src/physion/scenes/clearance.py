"""Whether bodies are free of one another, and how far one must rise to be.

Both by the convex pieces that stand for shapes in contacts.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from physion.scenes.placement import rotate, world_bounds
from physion.scenes.scene import Body
from physion.scenes.shapes import shape
from physion.scenes.stage import raised

GAP = 0.001
"""Metres left free where a body had to be raised off another one."""
TOUCH = 1e-6
"""Metres: bodies that overlap by less only touch."""
REFINE = np.stack(np.meshgrid(np.linspace(-1, 1, 5), np.linspace(-1, 1, 5)), axis=-1).reshape(-1, 2)
ROUNDS = 8
"""Rounds of a search for the best slope, each with half the step of the one before."""


def _slope_grid() -> NDArray[np.float64]:
    turns = 2 * np.pi * np.arange(16) / 16
    tilts = np.tan(np.radians([0.0, 10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0, 87.0, 89.5]))
    ways = np.stack([np.cos(turns), np.sin(turns)], axis=1)
    return np.asarray((tilts[:, None, None] * ways).reshape(-1, 2))


SLOPES = _slope_grid()
"""(K, 2): slopes along x and y that the search starts from, up to nearly upright."""


def cleared(body: Body, obstacles: Sequence[Body]) -> Body:
    """The body, raised above every one of ``obstacles`` that it would start in or under."""
    rise = needed_rise(body, obstacles)
    return raised(body, rise + GAP) if rise > 0 else body  # type: ignore[no-any-return]


def needed_rise(body: Body, obstacles: Sequence[Body]) -> float:
    """Metres by which ``body`` must rise until nothing of ``obstacles`` is in or above it.

    Never too few, by their convex pieces; too many by less than a millimetre.
    """
    (x0, y0, bottom), (x1, y1, _) = world_bounds(body)
    parts = _corners(body)
    need = 0.0
    for obstacle in obstacles:
        low, high = world_bounds(obstacle)
        if high[2] <= bottom + TOUCH or high[0] <= x0 or high[1] <= y0:
            continue
        if low[0] >= x1 or low[1] >= y1:
            continue
        for under in _corners(obstacle):
            for part in parts:
                need = max(need, _rise(under, part, need))
    return need if need > TOUCH else 0.0


def beside(body: Body, others: Sequence[Body]) -> bool:
    """Whether the level rectangle round ``body`` is free of those round ``others``."""
    low, high = world_bounds(body)
    boxes = [world_bounds(other) for other in others]
    return all((high[:2] < b[0, :2]).any() or (low[:2] > b[1, :2]).any() for b in boxes)


def _corners(body: Body) -> list[NDArray[np.float64]]:
    """World corners (K, 3) of each convex piece."""
    place = np.array(body.position)
    return [
        rotate(body.rotation, piece * body.scale) + place for piece in _unit_corners(body.shape)
    ]


@cache
def _unit_corners(name: str) -> tuple[NDArray[np.float64], ...]:
    return tuple(piece.mesh.vertices for piece in shape(name).pieces)


def _rise(under: NDArray[np.float64], part: NDArray[np.float64], enough: float) -> float:
    """How far a convex ``part`` must rise to be above ``under``, at least ``enough``.

    A plane z = ux + vy + c above all of ``under`` is below all of the part once it has risen by
    max(z - ux - vy) of the one plus max(ux + vy - z) of the other. The least over all slopes (u, v)
    is the answer; that of any slope is on the safe side.
    """

    def rises(slopes: NDArray[np.float64]) -> NDArray[np.float64]:
        over = (under[:, 2:] - under[:, :2] @ slopes.T).max(axis=0)
        return np.asarray(over + (part[:, :2] @ slopes.T - part[:, 2:]).max(axis=0))

    slopes, step = SLOPES, 0.35
    for _ in range(ROUNDS):
        found = rises(slopes)
        best = int(found.argmin())
        if found[best] <= enough:
            return enough
        least, slope = float(found[best]), slopes[best]
        slopes = slope + REFINE * step * (1 + float(slope @ slope))
        step *= 0.5
    return least
