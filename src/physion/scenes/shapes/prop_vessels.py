"""Vases, jugs, cups and what coffee is made with."""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np

from physion.scenes.scene import Look
from physion.scenes.shapes.prop_parts import PropPart, prop
from physion.scenes.shapes.prop_solids import (
    arc,
    ball,
    block,
    board,
    cushion,
    lathe,
    limb,
    outline,
    tube,
)

COFFEE = Look((0.16, 0.09, 0.06), "plastic_glossy")
BLACK = Look((0.06, 0.06, 0.065), "plastic_matte")
CHROME = Look((0.78, 0.79, 0.8), "metal_polished")
DARK_INSIDE = Look((0.12, 0.11, 0.1), "plain")


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
