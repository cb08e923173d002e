"""Plants, dogs and people."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from physion.numerics.elementary import cos, sin
from physion.numerics.linear_algebra import norm, ordered_mean, unit
from physion.scenes.scene import Look
from physion.scenes.shapes.meshes import Points
from physion.scenes.shapes.prop_parts import PropPart, prop
from physion.scenes.shapes.prop_solids import ball, curve, lathe, limb, loft, ring, tube
from physion.seeds import child_generator, named_seed

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
