"""Chairs, stools, tables and lamps."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

import numpy as np

from physion.numerics.elementary import cos, sin
from physion.scenes.scene import Look
from physion.scenes.shapes.prop_parts import PropPart, prop
from physion.scenes.shapes.prop_solids import (
    arc,
    ball,
    board,
    curve,
    cushion,
    lathe,
    limb,
    outline,
    sleeve,
    tube,
)

SHADE = Look((0.9, 0.85, 0.74), "fabric_linen")
BULB = Look((1.0, 0.98, 0.9), "plastic_matte")
CHROME = Look((0.78, 0.79, 0.8), "metal_polished")
DARK_WOOD = Look((0.4, 0.3, 0.22), "wood_walnut")
PAD = Look((0.3, 0.3, 0.33), "fabric_wool")
CORNERS = ((1, 1), (-1, 1), (-1, -1), (1, -1))


@prop("chair", (0.43, 0.497, 0.878))
def _chair() -> Iterable[PropPart]:
    """Model a wooden dining chair with three slats and a padded seat."""
    yield board((0, 0.01, 0.43), (0.215, 0.215, 0.025))
    yield cushion((0, 0.01, 0.463), (0.205, 0.205, 0.022), 0.02, PAD)
    for x in (-0.19, 0.19):
        yield limb((x, 0.19, 0.02), (x, 0.19, 0.43), 0.018, 0.024)
        back = [(x, -0.235, 0.0), (x, -0.19, 0.25), (x, -0.185, 0.46), (x, -0.25, 0.87)]
        yield tube(curve(back, 3), 0.022, rounded=False)
        yield limb((x, 0.19, 0.2), (x, -0.2, 0.2), 0.012)
    yield limb((-0.19, 0.0, 0.2), (0.19, 0.0, 0.2), 0.012)
    for z, y in ((0.6, -0.207), (0.71, -0.224), (0.83, -0.243)):
        yield board((0, y, z), (0.19, 0.01, 0.036))


@prop("cafe_chair", (0.46, 0.482, 0.864))
def _cafe_chair() -> Iterable[PropPart]:
    """Model a bistro chair of bent tubes with a round seat."""
    yield lathe([(0.19, 0.44), (0.205, 0.45), (0.205, 0.465), (0.19, 0.475)])
    for x in (-1, 1):
        yield tube([(0.14 * x, 0.12, 0.45), (0.17 * x, 0.2, 0.0)], 0.011)
        yield tube([(0.14 * x, -0.13, 0.45), (0.17 * x, -0.24, 0.0)], 0.011)
    sides = [(0.15, -0.13, 0.44), (0.18, -0.18, 0.6), (0.175, -0.22, 0.76), (0.1, -0.25, 0.84)]
    hoop = [*sides, (0, -0.255, 0.85), *((-x, y, z) for x, y, z in reversed(sides))]
    yield tube(curve(hoop, 3), 0.011)
    inner = [(0.08, -0.15, 0.46), (0.1, -0.19, 0.6), (0.07, -0.225, 0.73)]
    inner += [(0.0, -0.232, 0.765), *((-x, y, z) for x, y, z in reversed(inner))]
    yield tube(curve(inner, 3), 0.008)
    yield tube(arc((0, -0.013, 0.2), (0.222, 0, 0), (0, 0.222, 0), 0, 2 * math.pi, 25)[:-1], 0.008,
               sides=6, closed=True)  # fmt: skip


@prop("armchair", (0.82, 0.865, 0.849))
def _armchair() -> Iterable[PropPart]:
    """Model an upholstered easy chair."""
    yield cushion((0, 0.0, 0.22), (0.36, 0.38, 0.12), 0.04)
    yield cushion((0, 0.06, 0.4), (0.27, 0.34, 0.085), 0.06)
    back = cushion((0, -0.28, 0.57), (0.33, 0.11, 0.28), 0.07)
    yield back.rotated((1, 0, 0), 0.16, (0, -0.28, 0.3))
    for side in (-1, 1):
        yield cushion((0.335 * side, 0.02, 0.36), (0.075, 0.38, 0.25), 0.065)
        for y in (-0.32, 0.34):
            yield lathe([(0.018, 0.0), (0.028, 0.12)], look=DARK_WOOD, sides=10).moved(
                (0.31 * side, y, 0)
            )


@prop("stool", (0.429, 0.427, 0.5))
def _stool() -> Iterable[PropPart]:
    """Model a round wooden stool on four splayed legs."""
    yield lathe([(0.16, 0.455), (0.18, 0.465), (0.18, 0.49), (0.165, 0.5)])
    feet = [(0.2 * x, 0.2 * y, 0.015) for x, y in CORNERS]
    for x, y, z in feet:
        yield limb((x, y, z), (0.55 * x, 0.55 * y, 0.45), 0.015, 0.02)
    rungs = [(0.86 * x, 0.86 * y, 0.17) for x, y, _ in feet]
    for start, end in itertools.pairwise([*rungs, rungs[0]]):
        yield limb(start, end, 0.011)


@prop("bar_stool", (0.42, 0.42, 0.78))
def _bar_stool() -> Iterable[PropPart]:
    """Model a padded seat on a steel column with a foot ring."""
    yield lathe(outline([(0.16, 0.68), (0.185, 0.71), (0.19, 0.75), (0.16, 0.78)], 3))
    yield lathe([(0.1, 0.665), (0.16, 0.68)], look=CHROME, sides=16)
    yield lathe([(0.21, 0.0), (0.21, 0.012), (0.05, 0.035), (0.03, 0.06)], look=CHROME)
    yield tube([(0, 0, 0.04), (0, 0, 0.67)], 0.026, CHROME, sides=12)
    hoop = arc((0, 0, 0.27), (0.15, 0, 0), (0, 0.15, 0), 0, 2 * math.pi, 21)[:-1]
    yield tube(hoop, 0.011, CHROME, sides=6, closed=True)
    yield tube([(-0.15, 0, 0.27), (0.15, 0, 0.27)], 0.009, CHROME, sides=6)


@prop("table", (1.1, 1.1, 0.74))
def _table() -> Iterable[PropPart]:
    """Model a round dining table on a turned column with four feet."""
    yield lathe([(0.52, 0.7), (0.55, 0.715), (0.55, 0.735), (0.54, 0.74)], sides=32)
    column = [(0.06, 0.08), (0.085, 0.2), (0.05, 0.4), (0.065, 0.58), (0.2, 0.705)]
    yield lathe(outline(column, 3), sides=16)
    for x, y in CORNERS:
        foot = [(0.02, 0.2), (0.14, 0.15), (0.28, 0.05), (0.33, 0.03)]
        path = [(x * r, y * r, z) for r, z in foot]
        yield tube(curve(path, 2), np.linspace(0.045, 0.03, 7), rounded=True)


@prop("coffee_table", (1.1, 0.6, 0.42))
def _coffee_table() -> Iterable[PropPart]:
    """Model a low table with a shelf under its top."""
    yield cushion((0, 0, 0.4), (0.55, 0.3, 0.02), 0.01)
    yield board((0, 0, 0.14), (0.47, 0.22, 0.01))
    for x, y in CORNERS:
        yield board((0.49 * x, 0.24 * y, 0.19), (0.03, 0.03, 0.19))
    for side in (-1, 1):
        yield board((0, 0.24 * side, 0.35), (0.46, 0.012, 0.035))
        yield board((0.49 * side, 0, 0.35), (0.012, 0.21, 0.035))


@prop("side_table", (0.46, 0.46, 0.55))
def _side_table() -> Iterable[PropPart]:
    """Model a small round table with three slanting legs."""
    yield lathe([(0.215, 0.52), (0.23, 0.53), (0.23, 0.545), (0.22, 0.55)], sides=32)
    yield lathe([(0.12, 0.495), (0.12, 0.52)], sides=16)
    for angle in np.arange(3) * 2 * math.pi / 3 + math.pi / 2:
        x, y = cos(angle), sin(angle)
        yield tube([(0.205 * x, 0.205 * y, 0.0), (0.1 * x, 0.1 * y, 0.52)], [0.011, 0.019])


@prop("desk", (1.2, 0.6, 0.75))
def _desk() -> Iterable[PropPart]:
    """Model a writing desk with a stack of drawers on one side."""
    yield board((0, 0, 0.735), (0.6, 0.3, 0.015))
    yield board((0.36, -0.01, 0.4), (0.2, 0.27, 0.32))
    for z in (0.23, 0.43, 0.62):
        yield board((0.36, 0.265, z), (0.185, 0.008, 0.088))
        yield cushion((0.36, 0.282, z), (0.05, 0.012, 0.008), 0.007, CHROME)
    for y in (-0.26, 0.26):
        yield board((-0.56, y, 0.36), (0.025, 0.025, 0.36))
        yield board((0.54, y, 0.05), (0.02, 0.02, 0.05))
        yield board((0.18, y, 0.05), (0.02, 0.02, 0.05))
    yield board((-0.2, -0.26, 0.55), (0.36, 0.01, 0.17))


@prop("lamp", (0.4, 0.4, 0.62))
def _table_lamp() -> Iterable[PropPart]:
    """Model a table lamp: a turned foot under a cloth shade."""
    foot = [(0.1, 0.0), (0.1, 0.02), (0.06, 0.05), (0.09, 0.14), (0.1, 0.22), (0.05, 0.31)]
    yield lathe(outline([*foot, (0.018, 0.35)], 3), sides=20)
    yield tube([(0, 0, 0.34), (0, 0, 0.45)], 0.012, CHROME)
    yield sleeve([(0.2, 0.36), (0.12, 0.62)], 0.006, SHADE)
    yield ball((0, 0, 0.46), (0.035, 0.035, 0.045), BULB, sides=10)


@prop("floor_lamp", (0.46, 0.46, 1.6))
def _floor_lamp() -> Iterable[PropPart]:
    """Model a thin pole on a heavy disc, a drum shade on top."""
    yield lathe([(0.15, 0.0), (0.15, 0.02), (0.14, 0.03), (0.02, 0.04)])
    yield tube([(0, 0, 0.03), (0, 0, 1.4)], 0.013)
    yield sleeve([(0.23, 1.28), (0.18, 1.6)], 0.006, SHADE)
    yield ball((0, 0, 1.42), (0.04, 0.04, 0.05), BULB, sides=10)


@prop("desk_lamp", (0.22, 0.57, 0.573))
def _desk_lamp() -> Iterable[PropPart]:
    """Model a jointed arm that holds a cone over the desk."""
    base = lathe([(0.11, 0.0), (0.11, 0.015), (0.1, 0.025), (0.02, 0.035)]).moved((0, -0.1, 0))
    yield base
    elbow, wrist = (0.0, -0.25, 0.3), (0.0, 0.09, 0.5)
    for x in (-0.012, 0.012):
        yield tube([(x, -0.1, 0.03), (x, elbow[1], elbow[2])], 0.008, sides=6)
        yield tube([(x, elbow[1], elbow[2]), (x, wrist[1], wrist[2])], 0.008, sides=6)
    for joint in (elbow, wrist):
        yield tube([(-0.025, *joint[1:]), (0.025, *joint[1:])], 0.018, sides=10)
    cone = sleeve([(0.105, 0.0), (0.095, 0.03), (0.045, 0.11)], 0.004)
    cap = lathe([(0.046, 0.108), (0.034, 0.12), (0.028, 0.175)], sides=16)
    bulb = ball((0, 0, 0.045), (0.035, 0.035, 0.045), BULB, sides=10)
    for part in (cone, cap, bulb):
        yield part.moved((0, 0.15, 0.36)).rotated((1, 0, 0), 0.5, wrist)
