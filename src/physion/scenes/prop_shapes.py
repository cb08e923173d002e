"""Stand-ins for the library models of the official scenes: vases, chairs, dogs, lamps, ...

The official models may not be shipped, so each prop is built here from a few solids. It fills the
box [-0.5, 0.5] x [-0.5, 0.5] x [0, 1] exactly: a body's scale is the size of the model that it
stands for, whatever that is. Front is +y. Props are shapes like any other (``prop:vase``): mostly
scenery, but their parts are also pieces for contacts.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from physion.scenes.props import PREFIX
from physion.scenes.scene import Vec3
from physion.scenes.shapes import CURVED, Shape, ball_mesh, convex, shapes
from physion.scenes.solids import Mesh, Points, box, hull, merge, revolve

SIDES = 24
NATURAL_SIZES: dict[str, Vec3] = {
    "basket": (0.7, 0.7, 0.5),
    "boat": (0.55, 2.8, 0.45),
    "chair": (0.45, 0.5, 0.86),
    "coffee_maker": (0.3, 0.36, 0.42),
    "crate": (0.5, 0.5, 0.5),
    "dog": (0.22, 0.72, 0.52),
    "globe": (0.4, 0.36, 0.5),
    "jug": (0.2, 0.26, 0.26),
    "lamp": (0.42, 0.42, 0.62),
    "person": (0.52, 0.35, 1.74),
    "pillow": (0.16, 0.42, 0.42),
    "plant": (0.5, 0.5, 0.6),
    "rod": (0.07, 1.0, 0.07),
    "sculpture": (0.6, 0.6, 0.66),
    "slab": (0.4, 0.4, 0.03),
    "stool": (0.44, 0.44, 0.5),
    "table": (1.1, 1.1, 0.74),
    "vase": (0.32, 0.32, 0.5),
    "wineglass": (0.09, 0.09, 0.2),
}
"""Width, depth and height in metres that each prop looks right at."""


@dataclass(frozen=True, eq=False)
class Part:
    """One closed solid of a prop, and the corners of the convex pieces that stand for it."""

    mesh: Mesh
    pieces: tuple[Points, ...]


Maker = Callable[[], Iterable[Part]]


def _prop(name: str) -> Callable[[Maker], Maker]:
    """Register a builder of parts as the shape ``prop:name``, fitted to the unit box."""

    def add(parts_of: Maker) -> Maker:
        def make() -> Shape:
            parts = list(parts_of())
            low, high = merge(part.mesh for part in parts).bounds
            scale = 1 / (high - low)
            offset = -scale * np.array([*(low + high)[:2] / 2, low[2]])
            mesh = merge((p.mesh for p in parts), smooth=CURVED).moved(scale, offset)
            pieces = [convex(piece * scale + offset) for part in parts for piece in part.pieces]
            return Shape(PREFIX + name, mesh, tuple(pieces), hollow=len(pieces) > 1)

        shapes.register(PREFIX + name)(make)
        return parts_of

    return add


def _solid(mesh: Mesh) -> Part:
    return Part(mesh, (mesh.vertices,))


def _board(center: ArrayLike, half: ArrayLike) -> Part:
    return _solid(box(center, half))


def _block(low: Sequence[float], high: Sequence[float], bottom: float, top: float) -> Part:
    """A box that tapers: half sizes ``low`` at height ``bottom``, ``high`` at ``top``."""
    signs = [(x, y) for x in (-1, 1) for y in (-1, 1)]
    points = [(x * low[0], y * low[1], bottom) for x, y in signs]
    return _solid(hull(points + [(x * high[0], y * high[1], top) for x, y in signs]))


def _limb(start: ArrayLike, end: ArrayLike, thick: float, thin: float | None = None) -> Part:
    """A rounded limb from ``start`` to ``end``; radii ``thick`` and ``thin`` at the ends."""
    first = ball_mesh(thick, 12).moved(offset=start).vertices
    last = ball_mesh(thick if thin is None else thin, 12).moved(offset=end).vertices
    return _solid(hull(np.concatenate([first, last]), CURVED))


def _ball(center: ArrayLike, half: ArrayLike) -> Part:
    return _solid(ball_mesh(1.0, SIDES).moved(half, center))


def _turned(outline: Sequence[tuple[float, float]], wall: float | None = None) -> Part:
    """An ``outline`` of (radius, height) from the bottom up, turned; hollow if it has a ``wall``.

    Its pieces are the full slices between neighbouring points.
    """
    (_, bottom), (_, top) = outline[0], outline[-1]
    profile = [(0.0, bottom), *outline]
    if wall is None:
        profile.append((0.0, top))
    else:
        inside = [(max(r - wall, 0.3 * r), z) for r, z in outline if z > bottom + wall]
        profile += [*reversed(inside), (0.0, inside[0][1])]
    slices = [
        revolve([(0.0, a[1]), a, b, (0.0, b[1])], 12).vertices
        for a, b in itertools.pairwise(outline)
        if b[1] > a[1]
    ]
    return Part(revolve(profile, SIDES, smooth=CURVED), tuple(slices))


def _curve(points: Sequence[tuple[float, float]], steps: int = 5) -> list[tuple[float, float]]:
    """A smooth outline through ``points`` (Catmull-Rom)."""
    p = np.array([points[0], *points, points[-1]], np.float64)
    t = np.linspace(0, 1, steps, endpoint=False)[:, None]
    spans = []
    for a, b, c, d in zip(p, p[1:], p[2:], p[3:], strict=False):
        bend = (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3
        spans.append(0.5 * (2 * b + (c - a) * t + bend))
    walked = np.concatenate([*spans, p[-1:]])
    return [(float(r), float(z)) for r, z in walked]


@_prop("crate")
def _crate() -> Iterable[Part]:
    yield _board((0, 0, 0.5), (0.48, 0.48, 0.46))
    for x in (-0.46, 0.46):
        for y in (-0.46, 0.46):
            yield _board((x, y, 0.5), (0.04, 0.04, 0.5))
    for z in (0.04, 0.96):
        for side in (-0.46, 0.46):
            yield _board((side, 0, z), (0.035, 0.42, 0.039))
            yield _board((0, side, z), (0.42, 0.035, 0.039))


@_prop("basket")
def _basket() -> Iterable[Part]:
    wall = 0.04
    yield _board((0, 0, wall / 2), (0.5, 0.5, wall / 2))
    for side in (-1, 1):
        at = side * (0.5 - wall / 2)
        yield _board((at, 0, (1 + wall) / 2), (wall / 2, 0.5, (1 - wall) / 2))
        yield _board((0, at, (1 + wall) / 2), (0.5 - wall, wall / 2, (1 - wall) / 2))


@_prop("vase")
def _vase() -> Iterable[Part]:
    points = [(0.2, 0.0), (0.3, 0.16), (0.46, 0.45), (0.42, 0.66), (0.2, 0.84), (0.17, 0.92)]
    yield _turned(_curve([*points, (0.26, 1.0)]), wall=0.045)


@_prop("wineglass")
def _wineglass() -> Iterable[Part]:
    yield _turned([(0.4, 0.0), (0.38, 0.02), (0.06, 0.07), (0.05, 0.45), (0.09, 0.49)])
    bowl = [(0.06, 0.48), (0.34, 0.56), (0.45, 0.72), (0.42, 0.88), (0.36, 1.0)]
    yield _turned(_curve(bowl), wall=0.03)


@_prop("jug")
def _jug() -> Iterable[Part]:
    body = [(0.3, 0.0), (0.4, 0.2), (0.42, 0.5), (0.36, 0.8), (0.38, 1.0)]
    yield _turned(_curve(body), wall=0.04)
    turns = np.linspace(-0.45 * math.pi, 0.45 * math.pi, 6)
    arc = [(0.0, 0.36 + 0.26 * math.cos(t), 0.52 + 0.3 * math.sin(t)) for t in turns]
    for start, end in itertools.pairwise(arc):
        yield _limb(start, end, 0.045)


@_prop("chair")
def _chair() -> Iterable[Part]:
    yield _board((0, 0.01, 0.45), (0.21, 0.21, 0.02))
    for x in (-0.18, 0.18):
        yield _limb((x, 0.19, 0.02), (x, 0.18, 0.43), 0.018, 0.022)
        yield _limb((x, -0.22, 0.02), (x, -0.18, 0.45), 0.018, 0.022)
        yield _limb((x, -0.18, 0.45), (x, -0.25, 0.86), 0.022, 0.018)
        yield _limb((x, 0.18, 0.2), (x, -0.2, 0.2), 0.012)
    for z, y in ((0.6, -0.205), (0.7, -0.222), (0.81, -0.24)):
        yield _board((0, y, z), (0.18, 0.01, 0.033))


@_prop("stool")
def _stool() -> Iterable[Part]:
    yield _turned([(0.19, 0.44), (0.21, 0.46), (0.21, 0.49), (0.19, 0.505)])
    feet = [(0.2 * x, 0.2 * y, 0.015) for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))]
    for x, y, z in feet:
        yield _limb((x, y, z), (0.6 * x, 0.6 * y, 0.45), 0.016, 0.02)
    rungs = [(0.85 * x, 0.85 * y, 0.17) for x, y, _ in feet]
    for start, end in zip(rungs, rungs[1:] + rungs[:1], strict=True):
        yield _limb(start, end, 0.011)


@_prop("table")
def _table() -> Iterable[Part]:
    yield _turned([(0.5, 0.71), (0.54, 0.72), (0.54, 0.74)])
    column = [(0.05, 0.08), (0.08, 0.2), (0.045, 0.4), (0.06, 0.6), (0.16, 0.715)]
    yield _turned(_curve(column))
    for turn in np.arange(4) * math.pi / 2 + math.pi / 4:
        x, y = math.cos(turn), math.sin(turn)
        yield _limb((0.4 * x, 0.4 * y, 0.03), (0.03 * x, 0.03 * y, 0.14), 0.03, 0.05)


@_prop("lamp")
def _lamp() -> Iterable[Part]:
    base = [(0.2, 0.0), (0.19, 0.02), (0.1, 0.07), (0.035, 0.2), (0.025, 0.55)]
    yield _turned(_curve(base))
    yield _turned([(0.34, 0.5), (0.36, 0.52), (0.32, 0.98), (0.3, 1.0)], wall=0.02)


@_prop("globe")
def _globe() -> Iterable[Part]:
    yield _turned([(0.24, 0.0), (0.23, 0.03), (0.08, 0.07), (0.04, 0.17)])
    yield _ball((0, 0, 0.57), (0.36, 0.36, 0.36))
    turns = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 10)
    arc = [(0.42 * math.cos(t), 0.0, 0.57 + 0.42 * math.sin(t)) for t in turns]
    for start, end in itertools.pairwise(arc):
        yield _limb(start, end, 0.02)


@_prop("plant")
def _plant() -> Iterable[Part]:
    yield _turned([(0.17, 0.0), (0.24, 0.32), (0.27, 0.33), (0.27, 0.4)], wall=0.03)
    yield _turned([(0.21, 0.25), (0.225, 0.34)])
    rng = np.random.default_rng(7)  # the same plant for everybody
    for i in range(16):
        turn = i * math.pi * (3 - math.sqrt(5))
        reach, rise = 0.2 + 0.25 * rng.random(), 0.55 + 0.45 * rng.random()
        way = np.array([math.cos(turn), math.sin(turn), 0.0])
        side = np.array([-way[1], way[0], 0.0]) * 0.05
        root, middle = 0.04 * way + [0, 0, 0.33], 0.6 * reach * way + [0, 0, 0.9 * rise]
        tip = reach * way + [0, 0, rise - 0.12]
        thick = 0.012 * way + [0, 0, 0.012]
        yield _solid(hull([root, middle - side, middle + side, middle + thick, middle - thick]))
        yield _solid(hull([tip, middle - side, middle + side, middle + thick, middle - thick]))


@_prop("coffee_maker")
def _coffee_maker() -> Iterable[Part]:
    yield _block((0.16, 0.2), (0.15, 0.19), 0.0, 0.06)
    yield _board((0, -0.13, 0.2), (0.14, 0.06, 0.17))
    yield _block((0.15, 0.19), (0.13, 0.17), 0.34, 0.46)
    pot = [(0.07, 0.062), (0.1, 0.1), (0.11, 0.17), (0.08, 0.26), (0.085, 0.3)]
    jug = _turned(_curve(pot), wall=0.012)
    forward = (0.0, 0.06, 0.0)
    yield Part(jug.mesh.moved(offset=forward), tuple(piece + forward for piece in jug.pieces))
    yield _limb((0.0, 0.16, 0.26), (0.0, 0.2, 0.24), 0.013)
    yield _limb((0.0, 0.2, 0.24), (0.0, 0.19, 0.12), 0.013)


@_prop("dog")
def _dog() -> Iterable[Part]:
    yield _limb((0, 0.17, 0.36), (0, -0.2, 0.34), 0.105, 0.09)
    for x in (-0.06, 0.06):
        yield _limb((x, 0.2, 0.32), (x, 0.2, 0.06), 0.045, 0.03)
        yield _limb((x, 0.2, 0.035), (x, 0.235, 0.03), 0.03, 0.025)
        yield _limb((x, -0.21, 0.32), (x, -0.25, 0.17), 0.06, 0.035)
        yield _limb((x, -0.25, 0.17), (x, -0.23, 0.04), 0.035, 0.028)
        yield _limb((x, -0.23, 0.035), (x, -0.195, 0.03), 0.03, 0.025)
        yield _limb((1.15 * x, 0.32, 0.57), (1.45 * x, 0.33, 0.45), 0.028, 0.02)
    yield _limb((0, 0.21, 0.4), (0, 0.32, 0.53), 0.085, 0.075)
    yield _ball((0, 0.34, 0.55), (0.08, 0.09, 0.08))
    yield _limb((0, 0.4, 0.53), (0, 0.47, 0.51), 0.045, 0.035)
    yield _limb((0, -0.27, 0.38), (0, -0.38, 0.52), 0.025, 0.012)


@_prop("person")
def _person() -> Iterable[Part]:
    for x in (-0.1, 0.1):
        yield _limb((x, 0, 0.9), (x, 0.01, 0.48), 0.09, 0.065)
        yield _limb((x, 0.01, 0.48), (x, -0.02, 0.1), 0.06, 0.045)
        yield _limb((x, -0.03, 0.045), (x, 0.14, 0.035), 0.045, 0.035)
        yield _limb((2.1 * x, 0, 1.4), (2.6 * x, 0, 1.12), 0.055, 0.045)
        yield _limb((2.6 * x, 0, 1.12), (2.5 * x, 0.08, 0.86), 0.042, 0.035)
    yield _limb((-0.06, 0, 0.95), (0.06, 0, 0.95), 0.12)
    yield _solid(hull([*_ring(0.15, 0.1, 0.95), *_ring(0.22, 0.12, 1.35), *_ring(0.1, 0.08, 1.46)]))
    yield _limb((0, 0, 1.42), (0, 0.01, 1.54), 0.055)
    yield _ball((0, 0.01, 1.63), (0.08, 0.1, 0.115))


@_prop("sculpture")
def _sculpture() -> Iterable[Part]:
    yield _block((0.5, 0.45), (0.46, 0.41), 0.0, 0.08)
    for side in (-1, 1):
        yield _limb((side * 0.12, -0.08, 0.18), (side * 0.38, 0.12, 0.17), 0.11, 0.09)
        yield _limb((side * 0.38, 0.12, 0.16), (-side * 0.1, 0.28, 0.15), 0.085, 0.06)
        yield _limb((side * 0.22, -0.05, 0.6), (side * 0.3, 0.03, 0.38), 0.07, 0.055)
        yield _limb((side * 0.3, 0.03, 0.38), (side * 0.05, 0.2, 0.27), 0.055, 0.045)
    yield _limb((0, -0.07, 0.22), (0, -0.06, 0.56), 0.17, 0.19)
    yield _limb((0, -0.04, 0.7), (0, -0.03, 0.78), 0.07)
    yield _ball((0, -0.02, 0.87), (0.11, 0.12, 0.13))
    yield _ball((0, -0.03, 0.99), (0.05, 0.05, 0.05))


@_prop("pillow")
def _pillow() -> Iterable[Part]:
    # A superellipse across, a lens through: plump in the middle, thin at the seams.
    points = []
    for depth in np.linspace(-1, 1, 9):
        width = (1 - abs(depth) ** 2.5) ** 0.4
        for turn in np.arange(32) * math.pi / 16:
            c, s = math.cos(turn), math.sin(turn)
            x, z = math.copysign(abs(c) ** 0.6, c), math.copysign(abs(s) ** 0.6, s)
            points.append((0.18 * depth, 0.5 * width * x, 0.5 * width * z))
    yield _solid(hull(points, CURVED))


@_prop("boat")
def _boat() -> Iterable[Part]:
    rings = []
    for y in np.linspace(-1, 1, 9):
        beam = 0.12 * (1 - abs(y) ** 2.2) + 0.006
        rings += [(x * beam, 0.5 * y, 0.02 + 0.06 * y * y) for x in (-0.5, 0.5)]
        rings += [(x * beam, 0.5 * y, 0.13 + 0.05 * y * y) for x in (-1, 1)]
    yield _solid(hull(rings, CURVED))


@_prop("rod")
def _rod() -> Iterable[Part]:
    yield _limb((0, -0.48, 0.03), (0, 0.1, 0.03), 0.018, 0.02)
    yield _limb((0, 0.1, 0.03), (0, 0.48, 0.03), 0.02, 0.03)


@_prop("slab")
def _slab() -> Iterable[Part]:
    yield _turned([(0.46, 0.0), (0.5, 0.3), (0.5, 0.7), (0.46, 1.0)])


def _ring(x: float, y: float, z: float) -> list[Vec3]:
    turns = np.arange(12) * math.pi / 6
    return [(x * math.cos(t), y * math.sin(t), z) for t in turns]
