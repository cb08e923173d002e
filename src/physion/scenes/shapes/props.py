"""Props that replace the library models of the official scenes: vases, chairs, dogs, lamps, ...

The licence of the official models forbids shipping them, so each prop is built from a few solids. A
prop fills the box [-0.5, 0.5] x [-0.5, 0.5] x [0, 1] exactly, so that the scale of a body is the
size of the model it replaces. Its front is +y. Props are shapes like any other (``prop:vase``):
mostly scenery, but they have collision pieces as well.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.core.seeds import child_generator, named_seed
from physion.numerics.elementary import arctan2, cos, power, sin
from physion.numerics.linear_algebra import norm, ordered_mean, unit
from physion.scenes.scene import Look
from physion.scenes.shapes.meshes import Points, hull
from physion.scenes.shapes.primitives import ball_mesh, shapes
from physion.scenes.shapes.prop_shapes import (
    NATURAL_SIZES,
    PropPart,
    PropShape,
    arc,
    ball,
    block,
    board,
    curve,
    cushion,
    lathe,
    limb,
    loft,
    outline,
    prop,
    ring,
    sleeve,
    solid,
    tube,
)

# Chairs, stools, tables and lamps.

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


# Plants, dogs and people.

CLAY = Look((0.66, 0.42, 0.31), "plain")
GLAZED = Look((0.82, 0.82, 0.8), "plastic_glossy")
SOIL = Look((0.16, 0.11, 0.08), "plain")
STALK = Look((0.35, 0.33, 0.18), "plain")
WHITE_FUR = Look((0.88, 0.86, 0.82), "fur")
BLACK_FUR = Look((0.08, 0.07, 0.07), "fur")
NOSE = Look((0.05, 0.045, 0.045), "plastic_glossy")
SKIN = Look((0.72, 0.54, 0.44), "plain")
HAIR = Look((0.17, 0.12, 0.09), "fur")
TROUSERS = Look((0.18, 0.2, 0.28), "fabric_denim")
SHOES = Look((0.1, 0.09, 0.09), "plastic_matte")


def _leaf(path: ArrayLike, widths: ArrayLike, fold: float = 0.25) -> PropPart:
    """Model a leaf along ``path`` (K, 3): pointed at both ends, folded along its middle."""
    points = np.asarray(path, np.float64)
    way = points[-1] - points[0]
    across = np.cross(way, (0.0, 0.0, 1.0))
    across = unit(across) if norm(across) >= 1e-6 else np.array([1.0, 0.0, 0.0])
    up = np.cross(across, unit(np.gradient(points, axis=0)))
    width = np.maximum(np.asarray(widths, np.float64), 0.002)[:, None]
    thick = 0.002 * up
    rim = points + fold * width * up
    rings = np.stack([rim + width * across, points + thick, rim - width * across, points - thick])
    part = loft(np.swapaxes(rings, 0, 1))
    middle = len(points) // 2
    return PropPart(
        part.mesh, (np.concatenate(rings[:, : middle + 1]), np.concatenate(rings[:, middle:]))
    )


def _pot(radius: float, height: float, look: Look) -> Iterable[PropPart]:
    """Model a flower pot with a rim, full of soil."""
    lip = 0.8 * height
    wall = [(0.7 * radius, 0.0), (0.92 * radius, lip), (radius, lip + 0.005), (radius, height)]
    yield lathe(wall, wall=0.1 * radius, look=look)
    yield lathe([(0.8 * radius, 0.6 * height), (0.88 * radius, 0.9 * height)], look=SOIL, sides=16)


@prop("plant", (0.46, 0.482, 0.676))
def _plant() -> Iterable[PropPart]:
    """Model a garden plant: a tuft of arching blades in a clay pot."""
    yield from _pot(0.14, 0.22, CLAY)
    # The same plant for everybody.
    seed = named_seed("prop", "plant")
    rng = child_generator(seed, "blades")
    for i in range(34):
        angle = i * math.pi * (3 - math.sqrt(5))
        reach = 0.04 + 0.22 * math.sqrt((i + 0.5) / 34)
        rise = 0.62 - 1.0 * reach + 0.1 * rng.random()
        way = np.array([cos(angle), sin(angle), 0.0])
        stations = [(0.02, 0.19), (0.3 * reach, 0.19 + 0.6 * rise), (0.7 * reach, 0.16 + rise)]
        stations.append((reach, 0.19 + rise - 0.6 * reach))
        path = curve([r * way + [0, 0, z * 0.82 + 0.03] for r, z in stations], 2)
        yield _leaf(path, [0.005, 0.012, 0.017, 0.019, 0.017, 0.011, 0.002])


@prop("houseplant", (0.508, 0.473, 0.832))
def _houseplant() -> Iterable[PropPart]:
    """Model a rubber plant: a stem with broad leaves all the way up, in a white pot."""
    yield from _pot(0.15, 0.25, GLAZED)
    stem = curve([(0, 0, 0.2), (0.015, 0.01, 0.4), (-0.01, 0.0, 0.6), (0.0, 0.0, 0.74)], 2)
    yield tube(stem, np.linspace(0.014, 0.006, len(stem)), STALK, sides=6)
    for i in range(17):
        angle, fraction = i * math.pi * (3 - math.sqrt(5)), i / 16
        size = 0.27 - 0.12 * fraction
        way = np.array([cos(angle), sin(angle), 0.0])
        lift = 0.25 + 0.75 * fraction
        start = np.array([0, 0, 0.34 + 0.4 * fraction])
        bend = [
            (0.0, 0.0),
            (0.3, 0.28 * lift + 0.1),
            (0.65, 0.5 * lift + 0.06),
            (1.0, 0.6 * lift - 0.1),
        ]
        path = curve([start + size * (r * way + [0, 0, z]) for r, z in bend], 2)
        yield _leaf(path, np.array([0.02, 0.05, 0.17, 0.26, 0.27, 0.19, 0.01]) * size, 0.2)


@prop("cactus", (0.33, 0.2, 0.58))
def _cactus() -> Iterable[PropPart]:
    """Model a ribbed column with two arms, in a clay pot."""
    yield from _pot(0.1, 0.14, CLAY)
    yield _ribbed(np.array([(0, 0, z) for z in (0.1, 0.25, 0.4, 0.53)]), 0.05)
    left = [(-0.03, 0, 0.27), (-0.09, 0, 0.275), (-0.125, 0, 0.31), (-0.13, 0, 0.42)]
    right = [(0.03, 0, 0.33), (0.09, 0, 0.335), (0.13, 0, 0.37), (0.135, 0, 0.5)]
    for path in (left, right):
        yield _ribbed(curve(path, 3), 0.034)


def _ribbed(path: Points, radius: float) -> PropPart:
    """Model a rounded tube with a star for its section."""
    part = tube(path, radius, sides=20, rounded=True)
    count = (len(part.mesh.vertices) - 2) // 20
    rings = part.mesh.vertices[:-2].reshape(count, 20, 3)
    middle = ordered_mean(rings, axis=1)[:, None]
    star = np.where(np.arange(20) % 2 == 0, 1.0, 0.8)[:, None]
    return PropPart(loft(middle + star * (rings - middle)).mesh, part.pieces)


@prop("dog", (0.212, 0.886, 0.613))
def _dog() -> Iterable[PropPart]:
    """Model a standing hound: dark saddle, white legs, chest and muzzle."""
    spine = [(-0.27, 0.385), (-0.2, 0.375), (-0.05, 0.365), (0.1, 0.355), (0.19, 0.375)]
    torso = tube(
        [(0, y, z) for y, z in spine],
        [(0.07, 0.08), (0.082, 0.092), (0.078, 0.088), (0.09, 0.11), (0.07, 0.09)],
        sides=14,
        rounded=True,
    )
    torso = torso.patched(lambda c, n: (n[:, 2] < -0.3) | (c[:, 1] > 0.2), WHITE_FUR)
    yield torso.patched(
        lambda c, n: (c[:, 2] > 0.37) & (c[:, 1] > -0.22) & (c[:, 1] < 0.15), BLACK_FUR
    )
    neck = tube([(0, 0.17, 0.4), (0, 0.27, 0.51)], [0.082, 0.062], sides=10, rounded=True)
    yield neck.patched(lambda c, n: n[:, 1] > 0.45, WHITE_FUR)
    yield from _head((0.0, 0.31, 0.545))
    for x in (-0.058, 0.058):
        front = [(x, 0.15, 0.34), (x, 0.16, 0.18), (x, 0.155, 0.03)]
        yield tube(front, [0.048, 0.03, 0.025], WHITE_FUR, rounded=True)
        hind = [(x, -0.22, 0.36), (x, -0.2, 0.24), (x, -0.285, 0.14), (x, -0.27, 0.03)]
        thigh = tube(
            hind, [(0.045, 0.075), (0.04, 0.055), (0.026, 0.03), 2 * (0.024,)], rounded=True
        )
        yield thigh.patched(lambda c, n: c[:, 2] < 0.14, WHITE_FUR)
        for y in (0.18, -0.245):
            yield ball((x, y, 0.022), (0.032, 0.048, 0.022), WHITE_FUR, sides=10)
    tail = curve([(0, -0.3, 0.42), (0, -0.36, 0.47), (0, -0.385, 0.55)], 3)
    wag = tube(tail, np.linspace(0.024, 0.01, len(tail)), rounded=True, sides=8)
    yield wag.patched(lambda c, n: c[:, 2] > 0.52, WHITE_FUR)


def _head(at: Sequence[float]) -> Iterable[PropPart]:
    """Model a hound's head with its skull about ``at``, looking to +y."""
    x, y, z = at
    skull = tube(
        [(x, y - 0.02, z), (x, y + 0.03, z + 0.003), (x, y + 0.07, z - 0.012)],
        [(0.064, 0.062), (0.07, 0.066), (0.052, 0.048)],
        sides=12,
        rounded=True,
    )
    yield skull.patched(lambda c, n: (abs(c[:, 0] - x) < 0.016) & (c[:, 1] > y), WHITE_FUR)
    nose = (x, y + 0.168, z - 0.018)
    snout = [(x, y + 0.06, z - 0.022), (x, y + 0.145, z - 0.032)]
    yield tube(snout, [(0.043, 0.04), (0.034, 0.03)], WHITE_FUR, sides=10, rounded=True)
    yield ball(nose, (0.016, 0.013, 0.012), NOSE, sides=8)
    for side in (-1, 1):
        yield ball((x + 0.034 * side, y + 0.086, z + 0.018), (0.01, 0.009, 0.01), NOSE, sides=8)
        ear = ball((0, 0, -0.055), (0.013, 0.042, 0.068), sides=10)
        root = (x + 0.066 * side, y + 0.005, z + 0.035)
        yield ear.rotated((0, 1, 0), -0.28 * side).moved(root)


@prop("dog_sitting", (0.258, 0.573, 0.618))
def _dog_sitting() -> Iterable[PropPart]:
    """Model the same hound, sitting upright."""
    spine = [(-0.11, 0.13), (-0.1, 0.2), (-0.02, 0.31), (0.06, 0.39)]
    torso = tube(
        [(0, y, z) for y, z in spine],
        [(0.1, 0.11), (0.1, 0.105), (0.09, 0.1), (0.075, 0.08)],
        sides=14,
        rounded=True,
    )
    torso = torso.patched(lambda c, n: (n[:, 1] > 0.5) & (c[:, 2] > 0.2), WHITE_FUR)
    yield torso.patched(lambda c, n: (n[:, 1] < -0.25) & (c[:, 2] > 0.15), BLACK_FUR)
    neck = tube([(0, 0.06, 0.4), (0, 0.1, 0.52)], [0.07, 0.058], sides=10, rounded=True)
    yield neck.patched(lambda c, n: n[:, 1] > 0.4, WHITE_FUR)
    yield from _head((0.0, 0.11, 0.55))
    for side in (-1, 1):
        x = 0.055 * side
        front = [(x, 0.07, 0.36), (x, 0.1, 0.19), (x, 0.105, 0.03)]
        yield tube(front, [0.045, 0.03, 0.025], WHITE_FUR, rounded=True)
        yield ball((x, 0.13, 0.022), (0.03, 0.046, 0.022), WHITE_FUR, sides=10)
        yield ball((0.085 * side, -0.05, 0.1), (0.045, 0.11, 0.1), sides=14)
        yield ball((0.095 * side, 0.06, 0.025), (0.033, 0.08, 0.025), WHITE_FUR, sides=10)
    tail = curve([(0, -0.18, 0.05), (0, -0.24, 0.03), (0.05, -0.27, 0.028)], 3)
    yield tube(tail, np.linspace(0.025, 0.012, len(tail)), rounded=True)


@prop("person", (0.565, 0.282, 1.75))
def _person() -> Iterable[PropPart]:
    """Model a standing man in a pullover and jeans."""
    for x in (-0.095, 0.095):
        yield tube(
            [(x, 0, 0.95), (x, 0.01, 0.5), (x, -0.02, 0.07)],
            [(0.095, 0.1), (0.068, 0.075), (0.055, 0.06)],
            TROUSERS,
        )
        shoe = limb((x, -0.04, 0.045), (x, 0.13, 0.035), 0.045, 0.035, SHOES)
        yield shoe
        arm = [(2.05 * x, -0.005, 1.42), (2.45 * x, -0.02, 1.14), (2.5 * x, 0.05, 0.9)]
        yield tube(arm, [0.058, 0.05, 0.04], rounded=True)
        yield ball((2.5 * x, 0.065, 0.82), (0.03, 0.045, 0.07), SKIN, sides=8)
    hips, waist, chest = ring(0.16, 0.11, 0.9), ring(0.165, 0.105, 1.1), ring(0.205, 0.12, 1.34)
    trunk = [hips, waist, chest, ring(0.19, 0.1, 1.44), ring(0.075, 0.06, 1.5)]
    yield loft(np.array(trunk))
    yield tube([(0, 0, 1.46), (0, 0.01, 1.58)], 0.055, SKIN)
    yield ball((0, 0.015, 1.63), (0.078, 0.098, 0.115), SKIN)
    yield ball((0, -0.008, 1.65), (0.084, 0.095, 0.1), HAIR)
    yield ball((0, 0.112, 1.62), (0.013, 0.02, 0.02), SKIN, sides=6)


# Boxes, globes, cushions and the other odd things of the official scenes.

SEA = Look((0.3, 0.46, 0.66), "plastic_glossy")
LAND = Look((0.52, 0.6, 0.34), "plastic_glossy")
ICE = Look((0.9, 0.92, 0.94), "plastic_glossy")
BRASS = Look((0.72, 0.6, 0.36), "metal_polished")
INSIDE = Look((0.2, 0.16, 0.12), "plain")

# Ten degrees a column from 180 W, ten degrees a row from 80 N; # is land, * is ice.
WORLD = """
......#..#####****..................
.########.#####***......##.#########
..##########..#**..#..##############
.....#########...#..###############.
......########.....################.
......######.......##############.#.
.......####........##.#.##########..
........##.........############.....
........###.......######.#.##..#....
..........###.....########.#..#.#...
..........######...######..........#
...........#####....#####.....##.#..
...........####.....####.#...######.
...........###......###......######.
..........###........#........#..#.#
..........##.......................#
..........#.........................
...*****......*******************...
"""


@prop("globe", (0.325, 0.3, 0.446))
def _globe() -> Iterable[PropPart]:
    """Model a globe of the earth in a brass half ring on a wooden foot."""
    yield lathe([(0.12, 0.0), (0.12, 0.02), (0.1, 0.03), (0.03, 0.05), (0.02, 0.085)])
    center, radius = (0.0, 0.0, 0.285), 0.15
    tilt = math.radians(23.4)
    earth = PropPart(ball_mesh(radius, 44), (ball_mesh(radius, 16).vertices,), SEA)
    earth = earth.patched(lambda c, n: _world(c, "#"), LAND).patched(
        lambda c, n: _world(c, "*"), ICE
    )
    half = arc((0, 0, 0), (0.168, 0, 0), (0, 0, 0.168), -math.pi / 2, math.pi / 2, 13)
    frame = tube(half, [(0.008, 0.008)] * 13, BRASS)
    pins = (tube([(0, 0, s * 0.145), (0, 0, s * 0.172)], 0.007, BRASS) for s in (-1, 1))
    for part in (earth, frame, *pins):
        yield part.rotated((0, 1, 0), tilt).moved(center)


def _world(centers: NDArray[np.float64], kind: str) -> NDArray[np.bool_]:
    """Return which points (F, 3) around the globe's centre are of ``kind``: land (#) or ice (*)."""
    ground = np.array([[mark == kind for mark in row] for row in WORLD.split()], np.float64)
    x, y, z = centers.T
    row = (90 - np.degrees(arctan2(z, np.sqrt(x * x + y * y)))) / 10 - 0.5
    # The Atlantic faces +y.
    column = (np.degrees(arctan2(y, x)) + 60.0) / 10 - 0.5
    # Between the squares of the map, so that coasts are not all steps; beyond its edges it repeats.
    rows, columns = ground.shape
    south, east = row - np.floor(row), column - np.floor(column)
    i, j = np.floor(row).astype(int) % rows, np.floor(column).astype(int) % columns
    below, right = (i + 1) % rows, (j + 1) % columns
    upper = (1 - east) * ground[i, j] + east * ground[i, right]
    lower = (1 - east) * ground[below, j] + east * ground[below, right]
    return np.asarray((1 - south) * upper + south * lower > 0.5)


@prop("moon_globe", (0.3, 0.3, 0.36))
def _moon_globe() -> Iterable[PropPart]:
    """Model a globe of the moon on a low ring."""
    yield lathe([(0.1, 0.0), (0.1, 0.02), (0.07, 0.04), (0.085, 0.08)], look=BRASS)
    yield ball((0, 0, 0.21), (0.15, 0.15, 0.15), sides=32)


@prop("crate", (0.5, 0.5, 0.5))
def _crate() -> Iterable[PropPart]:
    """Model a slatted wooden crate."""
    yield board((0, 0, 0.25), (0.215, 0.215, 0.24), INSIDE)
    for x in (-0.215, 0.215):
        for y in (-0.215, 0.215):
            yield board((x, y, 0.25), (0.022, 0.022, 0.25))
    for z in (0.055, 0.185, 0.315, 0.445):
        for side in (-0.24, 0.24):
            yield board((side, 0, z), (0.01, 0.25, 0.054))
            yield board((0, side, z), (0.23, 0.0099, 0.054))
    for x in (-0.18, -0.06, 0.06, 0.18):
        yield board((x, 0, 0.485), (0.053, 0.229, 0.008))


@prop("basket", (0.698, 0.696, 0.5))
def _basket() -> Iterable[PropPart]:
    """Model a square woven basket with a thick rim, open above."""
    wall, flare = 0.02, 0.045
    yield block((0.3, 0.3), (0.3, 0.3), 0.0, wall)
    corners = [(-1, -1), (1, -1), (1, 1), (-1, 1)]
    for (ax, ay), (bx, by) in zip(corners, corners[1:] + corners[:1], strict=True):
        foot, top = 0.35 - flare, 0.335
        low = [(ax * foot, ay * foot, 0.0), (bx * foot, by * foot, 0.0)]
        low += [(x * (1 - wall / foot), y * (1 - wall / foot), 0.0) for x, y, _ in low]
        high = [(ax * top, ay * top, 0.48), (bx * top, by * top, 0.48)]
        high += [(x * (1 - wall / top), y * (1 - wall / top), 0.48) for x, y, _ in high]
        yield solid(hull([*low, *high]))
        yield limb((ax * 0.328, ay * 0.328, 0.478), (bx * 0.328, by * 0.328, 0.478), 0.022)


@prop("carton", (0.797, 0.59, 0.432))
def _carton() -> Iterable[PropPart]:
    """Model a cardboard box, its flaps open, with a label."""
    x, y, high, wall = 0.27, 0.19, 0.32, 0.004
    yield board((0, 0, wall), (x, y, wall))
    for side in (-1, 1):
        yield board((side * x, 0, high / 2), (wall, y + wall, high / 2))
        yield board((0, side * y, high / 2), (x - wall, wall, high / 2))
        flap = board((0, 0, 0.075), (wall, y, 0.075))
        yield flap.rotated((0, 1, 0), side * 1.0).moved((side * x, 0, high))
        flap = board((0, 0, 0.075), (x, wall, 0.075))
        yield flap.rotated((1, 0, 0), side * -0.75).moved((0, side * y, high))
        label = Look((0.92, 0.92, 0.9), "plain")
        yield board((side * 0.11, side * (y + wall), 0.17), (0.09, 0.002, 0.055), label)


@prop("pillow", (0.16, 0.42, 0.42))
def _pillow() -> Iterable[PropPart]:
    """Model a throw pillow: plump in the middle, thin at the seams, drawn out at the corners."""
    sides, rings = 32, []
    angles = 2 * math.pi * (np.arange(sides) + 0.5) / sides
    c, s = cos(angles), sin(angles)
    square = np.stack([np.sign(c) * power(abs(c), 0.45), np.sign(s) * power(abs(s), 0.45)], axis=1)
    depths = np.array([-0.98, -0.85, -0.6, -0.3, 0.0, 0.3, 0.6, 0.85, 0.98])
    widths = 0.21 * power(1 - power(abs(depths), 1.6), 0.55) / np.abs(square).max()
    for depth, width in zip(depths, widths, strict=True):
        x = np.full((sides, 1), 0.08 * depth / 0.98)
        rings.append(np.concatenate([x, width * square], axis=1))
    mesh = loft(np.array(rings)).mesh
    yield PropPart(mesh, (mesh.vertices,))


@prop("sculpture", (0.64, 0.64, 0.72))
def _sculpture() -> Iterable[PropPart]:
    """Model a seated buddha on a plinth."""
    yield lathe([(0.3, 0.0), (0.32, 0.02), (0.3, 0.05), (0.31, 0.08)])
    for side in (-1, 1):
        yield limb((side * 0.1, -0.04, 0.16), (side * 0.23, 0.1, 0.13), 0.075, 0.06)
        yield limb((side * 0.23, 0.1, 0.13), (-side * 0.06, 0.17, 0.12), 0.055, 0.04)
        yield limb((side * 0.15, -0.03, 0.43), (side * 0.2, 0.02, 0.28), 0.05, 0.04)
        yield limb((side * 0.2, 0.02, 0.28), (side * 0.04, 0.13, 0.2), 0.04, 0.032)
        yield ball((side * 0.075, 0.0, 0.57), (0.014, 0.02, 0.04), sides=8)
    yield limb((0, -0.03, 0.18), (0, -0.03, 0.4), 0.13, 0.125)
    yield limb((0, -0.02, 0.45), (0, -0.01, 0.53), 0.05)
    yield ball((0, 0.0, 0.59), (0.075, 0.082, 0.09))
    yield ball((0, -0.01, 0.683), (0.04, 0.04, 0.037), sides=12)


@prop("boat", (0.584, 2.8, 0.45))
def _boat() -> Iterable[PropPart]:
    """Model a kayak with a cockpit."""
    rings = []
    stations = np.linspace(-1, 1, 15)
    beams = 0.28 * (1 - power(abs(stations), 2.2)) + 0.012
    for y, beam in zip(stations, beams, strict=True):
        keel, deck = 0.06 * y * y + 0.1 * max(abs(y) - 0.8, 0), 0.26 + 0.1 * (y * y) * (y * y)
        section = [(-0.45, keel), (0.45, keel), (0.9, 0.4), (1.0, 0.75), (0.6, 0.93), (0.0, 1.0)]
        heights = [keel, keel] + [keel + f * (deck - keel) for _, f in section[2:]]
        points = [(x * beam, 1.4 * y, z) for (x, _), z in zip(section, heights, strict=True)]
        points += [
            (-x * beam, 1.4 * y, z)
            for (x, _), z in zip(section[4:1:-1], heights[4:1:-1], strict=True)
        ]
        rings.append(points)
    yield loft(np.array(rings))
    rim = arc((0, -0.1, 0.275), (0.17, 0, 0), (0, 0.36, 0), 0, 2 * math.pi, 25)[:-1]
    yield tube(rim, 0.018, Look((0.1, 0.1, 0.1), "plastic_matte"), sides=6, closed=True)
    hole = ball((0, -0.1, 0.25), (0.165, 0.355, 0.025), Look((0.05, 0.05, 0.05), "plain"), sides=20)
    yield hole
    yield cushion(
        (0, -0.36, 0.36), (0.13, 0.03, 0.09), 0.025, Look((0.1, 0.1, 0.1), "plastic_matte")
    )


@prop("rod", (0.072, 1.0, 0.07))
def _rod() -> Iterable[PropPart]:
    """Model a baseball bat, lying."""
    profile = [(-0.5, 0.024), (-0.485, 0.026), (-0.47, 0.016), (-0.2, 0.015), (0.1, 0.024)]
    profile += [(0.3, 0.033), (0.44, 0.036), (0.485, 0.032), (0.5, 0.02)]
    bat = tube([(0, y, 0.036) for y, _ in profile], [r for _, r in profile], sides=14)
    grip = Look((0.1, 0.09, 0.08), "plastic_matte")
    yield bat.patched(lambda c, n: (c[:, 1] < -0.25) & (c[:, 1] > -0.46), grip)


@prop("slab", (0.4, 0.4, 0.03))
def _slab() -> Iterable[PropPart]:
    """Model a plate or a coin."""
    yield lathe([(0.18, 0.0), (0.2, 0.01), (0.2, 0.02), (0.18, 0.03)])


# Vases, jugs, cups and what coffee is made with.

COFFEE = Look((0.16, 0.09, 0.06), "plastic_glossy")
BLACK = Look((0.06, 0.06, 0.065), "plastic_matte")


@prop("vase", (0.326, 0.326, 0.5))
def _vase() -> Iterable[PropPart]:
    """Model a round belly under a short neck and a flared lip."""
    points = [(0.07, 0.0), (0.1, 0.07), (0.16, 0.22), (0.145, 0.33), (0.07, 0.42), (0.058, 0.46)]
    yield lathe(outline([*points, (0.088, 0.5)]), wall=0.014)


@prop("vase_bottle", (0.301, 0.301, 0.62))
def _vase_bottle() -> Iterable[PropPart]:
    """Model a full body that narrows to a long thin neck."""
    points = [(0.1, 0.0), (0.14, 0.08), (0.15, 0.2), (0.12, 0.34), (0.05, 0.44), (0.04, 0.54)]
    yield lathe(outline([*points, (0.056, 0.61), (0.062, 0.62)]), wall=0.012)


@prop("vase_beaker", (0.2, 0.2, 0.3))
def _vase_beaker() -> Iterable[PropPart]:
    """Model an open vase whose wall leans outwards, on a heavy foot."""
    points = [(0.062, 0.0), (0.066, 0.02), (0.06, 0.05), (0.072, 0.16), (0.1, 0.3)]
    yield lathe(outline(points), wall=0.01)


@prop("vase_amphora", (0.356, 0.3, 0.55))
def _vase_amphora() -> Iterable[PropPart]:
    """Model a two-handled jar with bands round its shoulder."""
    points = [(0.07, 0.0), (0.065, 0.03), (0.11, 0.14), (0.15, 0.3), (0.11, 0.4), (0.055, 0.45)]
    body = lathe(outline([*points, (0.05, 0.5), (0.075, 0.55)]), wall=0.014)
    band = Look((0.2, 0.13, 0.1), "plain")
    yield body.patched(lambda c, n: (abs(c[:, 2] - 0.325) < 0.02) | (c[:, 2] < 0.04), band)
    for side in (-1, 1):
        path = [(0.05, 0.51), (0.12, 0.52), (0.16, 0.47), (0.165, 0.41), (0.125, 0.365)]
        yield tube([(side * x, 0.0, z) for x, z in path], 0.013)


@prop("jug", (0.2, 0.284, 0.26))
def _jug() -> Iterable[PropPart]:
    """Model a pitcher: a handle behind, a lip in front."""
    body = [(0.07, 0.0), (0.09, 0.05), (0.1, 0.11), (0.075, 0.19), (0.078, 0.26)]
    part = lathe(outline(body), wall=0.009)
    # The rim is drawn out to a lip.
    vertices = part.mesh.vertices.copy()
    high = np.clip((vertices[:, 2] - 0.2) / 0.06, 0.0, 1.0) ** 2
    ahead = np.clip(vertices[:, 1] / 0.078, 0.0, 1.0) ** 2
    vertices[:, 1] += 0.045 * high * (ahead * ahead * ahead)
    yield PropPart(type(part.mesh)(vertices, part.mesh.faces, part.mesh.smooth), part.pieces)
    path = arc((0, -0.085, 0.145), (0, -0.065, 0), (0, 0, 0.08), -0.55 * math.pi, 0.5 * math.pi, 8)
    yield tube(path, 0.011)


@prop("mug", (0.102, 0.102, 0.1))
def _mug() -> Iterable[PropPart]:
    """Model a mug of coffee; its handle is seen from the front and from the side."""
    wall = [(0.038, 0.0), (0.0415, 0.006), (0.0425, 0.05), (0.0425, 0.1)]
    yield lathe(wall, wall=0.004)
    yield lathe([(0.0375, 0.07), (0.0375, 0.084)], look=COFFEE)
    path = arc((0, -0.04, 0.052), (0, -0.0355, 0), (0, 0, 0.03), -0.5 * math.pi, 0.5 * math.pi, 8)
    yield tube(path, 0.007).rotated((0, 0, 1), math.pi / 4)


@prop("bowl", (0.34, 0.34, 0.15))
def _bowl() -> Iterable[PropPart]:
    """Model a fruit bowl with apples, oranges and a pear in it."""
    points = [(0.06, 0.0), (0.058, 0.014), (0.11, 0.035), (0.152, 0.075), (0.17, 0.12)]
    yield lathe(outline(points, 3), wall=0.009)
    green, orange = Look((0.45, 0.6, 0.2), "plastic_matte"), Look((0.8, 0.46, 0.2), "plastic_matte")
    plum = Look((0.3, 0.14, 0.26), "plastic_matte")
    fruit = [(0.0, 0.0, green), (0.085, 0.02, orange), (-0.03, 0.085, plum)]
    fruit += [(-0.085, -0.02, orange), (0.03, -0.085, green)]
    for x, y, look in fruit:
        yield ball((x, y, 0.105), (0.046, 0.046, 0.045), look, sides=12)


@prop("wineglass", (0.091, 0.091, 0.2))
def _wineglass() -> Iterable[PropPart]:
    """Model a stemmed glass, half full."""
    yield lathe([(0.038, 0.0), (0.036, 0.003), (0.006, 0.012), (0.0045, 0.09), (0.008, 0.098)])
    bowl = [(0.006, 0.096), (0.032, 0.11), (0.045, 0.14), (0.042, 0.17), (0.035, 0.2)]
    yield lathe(outline(bowl), wall=0.002)


@prop("coffee_maker", (0.22, 0.342, 0.36))
def _coffee_maker() -> Iterable[PropPart]:
    """Model a filter machine: tank behind, head above, a glass pot of coffee on its plate."""
    yield cushion((0, 0.01, 0.025), (0.11, 0.16, 0.025), 0.012)
    yield cushion((0, -0.105, 0.18), (0.11, 0.055, 0.18), 0.015)
    yield cushion((0, 0.005, 0.305), (0.11, 0.155, 0.055), 0.018)
    yield lathe([(0.045, 0.215), (0.075, 0.255)], look=BLACK).moved((0, 0.065, 0))
    yield lathe([(0.082, 0.049), (0.082, 0.056)], look=CHROME).moved((0, 0.065, 0))
    yield board((0, 0.161, 0.305), (0.06, 0.0015, 0.02), BLACK)
    yield ball((0.045, 0.163, 0.305), (0.01, 0.005, 0.01), CHROME, sides=8)
    pot = [(0.06, 0.056), (0.078, 0.08), (0.08, 0.12), (0.06, 0.18), (0.056, 0.2)]
    clear = Look((0.62, 0.66, 0.68), "plastic_glossy")
    glass = lathe(outline(pot, 3), look=clear).patched(lambda c, n: c[:, 2] < 0.135, COFFEE)
    yield glass.moved((0, 0.065, 0))
    yield lathe([(0.058, 0.198), (0.056, 0.212)], look=BLACK).moved((0, 0.065, 0))
    grip = [(0.0, 0.115, 0.195), (0.0, 0.165, 0.185), (0.0, 0.171, 0.13), (0.0, 0.142, 0.09)]
    yield tube(grip, (0.011), BLACK, rounded=True)


@prop("moka_pot", (0.11, 0.18, 0.2))
def _moka_pot() -> Iterable[PropPart]:
    """Model an eight-sided stove pot with a black handle and knob."""
    foot = lathe([(0.055, 0.0), (0.055, 0.012), (0.04, 0.085)], sides=8)
    yield foot
    yield lathe([(0.042, 0.085), (0.042, 0.097)], look=CHROME, sides=16)
    yield lathe([(0.038, 0.097), (0.052, 0.17)], sides=8)
    yield lathe([(0.054, 0.17), (0.05, 0.178), (0.01, 0.187)], sides=8)
    yield ball((0, 0, 0.19), (0.01, 0.01, 0.01), BLACK, sides=10)
    yield block((0.006, 0.006), (0.02, 0.016), 0.13, 0.17).moved((0, 0.052, 0))
    yield limb((0, -0.045, 0.165), (0, -0.1, 0.163), 0.009, 0.011, BLACK)
    yield limb((0, -0.1, 0.163), (0, -0.105, 0.1), 0.011, 0.008, BLACK)


__all__ = ["NATURAL_SIZES", "PropShape", "shapes"]
