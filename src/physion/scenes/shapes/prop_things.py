"""Boxes, globes, cushions and the other odd things of the official scenes."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import arctan2, cos, power, sin
from physion.scenes.scene import Look
from physion.scenes.shapes.meshes import hull
from physion.scenes.shapes.primitives import ball_mesh
from physion.scenes.shapes.prop_parts import PropPart, prop
from physion.scenes.shapes.prop_solids import (
    arc,
    ball,
    block,
    board,
    cushion,
    lathe,
    limb,
    loft,
    solid,
    tube,
)

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
