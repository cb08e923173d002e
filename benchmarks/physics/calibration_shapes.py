"""Shapes and scenes that `calibrate.py` tries in place of the present ones.

Each function takes a value of a quantity and returns what stands for it: a collision shape at unit
scale, mass properties, or a scene. The first value of every quantity gives the present shape.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from physion.numerics.elementary import cos, sin
from physion.physics.rigid.bodies import MassProperties
from physion.scenes.scene import Body, Scene
from physion.scenes.shapes import primitives
from physion.scenes.shapes.meshes import box, hull, revolve
from physion.scenes.shapes.primitives import Shape, convex, ring_pieces

BASKET = (0.72, 0.72, 0.4973)
"""Recorded size of the woven box, metres."""
RAMP_GRADE, RAMP_LENGTH, RAMP_HEIGHT = 0.3, 4.9529, 1.0007
"""Slope, length and height of the ramp of the recorded trials."""
LEDGE_LENGTH = 10.0
"""A ball that is stretched along y to more than this is a ledge."""


def pentagon(bevel: float, corner: float = -1.0) -> Shape:
    """Return a pentagonal prism whose rims are cut by ``bevel``; one edge is at y = corner / 2."""
    angles = corner * np.pi / 2 + 2 * np.pi * np.arange(5) / 5
    levels = [(0.0, bevel), (bevel, 0.0), (1.0 - bevel, 0.0), (1.0, bevel)]
    points = [
        ((0.5 - cut) * cos(t), (0.5 - cut) * sin(t), z)
        for z, cut in (levels if bevel else levels[1:3])
        for t in angles
    ]
    return solid("pentagon", np.array(points))


def pentagon_turned(corner: float) -> Shape:
    """Return a sharp pentagonal prism with an edge at y = corner / 2."""
    return pentagon(0.0, corner)


def cone(tip: float) -> Shape:
    """Return a cone that ends in a disc of radius ``tip``."""
    profile = [(0.0, 0.0), (0.5, 0.0), *([(tip, 1.0)] if tip else []), (0.0, 1.0)]
    mesh = revolve(profile, primitives.CONE_SEGMENTS, phase=math.pi / 2)
    return solid("cone", mesh.vertices)


def pyramid(tip: float) -> Shape:
    """Return a pyramid that ends in a square of ``tip`` half a side."""
    points = [
        (x * half, y * half, z)
        for half, z in ((0.75 / math.sqrt(2), 0.0), (tip, 1.0))
        for x in (-1, 1)
        for y in (-1, 1)
    ]
    return solid("pyramid", np.array(points if tip else [*points[:4], (0.0, 0.0, 1.0)]))


def pipe(inner: float, bevel: float = 0.0) -> Shape:
    """Return a pipe of this inner radius, all four rims cut by ``bevel``."""
    if not bevel:
        section = [(inner, 0.0), (0.5, 0.0), (0.5, 1.0), (inner, 1.0)]
    else:
        low = [(inner, bevel), (inner + bevel, 0.0), (0.5 - bevel, 0.0), (0.5, bevel)]
        section = [*low, *((r, 1.0 - z) for r, z in reversed(low))]
    return ring("pipe", section)


def pipe_rim(bevel: float) -> Shape:
    """Return the pipe with the present wall and cut rims."""
    return pipe(primitives.PIPE_PIECE_INNER, bevel)


def pipe_joint(value: tuple[float, float]) -> Shape:
    """Return the pipe of an inner radius; see `pipe_center` for the second number."""
    return pipe(value[0])


def pipe_center(value: float | tuple[float, float], found: MassProperties) -> MassProperties:
    """Return mass properties with the centre moved along the axis by a fraction of the height.

    The inertia about the centre of mass stays as it is. The centre of the pieces is at half the
    height, so that it gives the height of the body.
    """
    shift = value[1] if isinstance(value, tuple) else value
    center = found.center * np.array([1.0, 1.0, 1.0 + 2.0 * shift])
    return replace(found, center=center)


def basket(value: tuple[float, float, bool]) -> Shape:
    """Return a woven box with walls and a floor of these metres, closed above or not."""
    wall, floor, closed = value
    x, y, z = BASKET
    boards = [((0.0, 0.0, floor / 2), (x / 2, y / 2, floor / 2))]
    boards += [((s * (x - wall) / 2, 0.0, z / 2), (wall / 2, y / 2, z / 2)) for s in (-1, 1)]
    boards += [((0.0, s * (y - wall) / 2, z / 2), (x / 2, wall / 2, z / 2)) for s in (-1, 1)]
    if closed:
        boards.append(((0.0, 0.0, z - floor / 2), (x / 2, y / 2, floor / 2)))
    pieces = tuple(convex(box(*board).vertices / np.array(BASKET)) for board in boards)
    return Shape("prop:basket", box((0.0, 0.0, 0.5), (0.5, 0.5, 0.5)), pieces, hollow=True)


def ramp(
    lift: float = 0.0, edge: float = 0.0, bevel: float = 0.0, length: float = RAMP_LENGTH
) -> Shape:
    """Return the ramp raised by ``lift``, with the edge of its platform moved by ``edge`` along x.

    ``bevel`` cuts that edge and the one at the end of the platform, ``length`` moves the end.
    """
    foot = -primitives.RAMP_FOOT
    top, end, high = foot + RAMP_HEIGHT / RAMP_GRADE + edge, foot + length, RAMP_HEIGHT
    side = [(foot, 0.0), (top, high), (end, high), (end, 0.0)]
    if bevel:
        slope = (top - foot) / high
        side[1:3] = [
            (top - bevel * slope, high - bevel),
            (top + bevel, high),
            (end - bevel, high),
            (end, high - bevel),
        ]
    half = primitives.RAMP_DEPTH / 2
    corners = [(x, y, z + lift) for x, z in side for y in (-half, half)]
    return solid("ramp_with_platform_30", np.array(corners))


def ramp_edge(value: float) -> Shape:
    """Return the ramp with the edge between slope and platform moved by ``value`` along x."""
    return ramp(edge=value)


def ramp_bevel(value: float) -> Shape:
    """Return the ramp with cut upper edges."""
    return ramp(bevel=value)


def ramp_end(value: float) -> Shape:
    """Return the ramp with the end of its platform moved by ``value`` along x."""
    return ramp(length=RAMP_LENGTH + value)


def ledge_shape(scene: Scene, value: str | int) -> Scene:
    """Return the scene with a half cylinder or a bar in place of the stretched ball of the ledge.

    ``value`` is the name of the new shape, or "sphere" for the present one.
    """
    if value == "sphere":
        return scene

    def changed(body: Body) -> Body:
        if not is_ledge(body):
            return body
        x, y, z = body.position
        middle = z + body.scale[2] / 2
        if value == "half:cylinder":
            return replace(body, shape="half:cylinder", position=(x, y, middle))
        return replace(body, shape="cube")

    return replace(scene, bodies=tuple(changed(body) for body in scene.bodies))


def ledge_height(scene: Scene, value: float) -> Scene:
    """Return the scene with the ledge raised by ``value`` metres."""
    bodies = tuple(
        replace(b, position=(b.position[0], b.position[1], b.position[2] + value))
        if is_ledge(b)
        else b
        for b in scene.bodies
    )
    return replace(scene, bodies=bodies)


def is_ledge(body: Body) -> bool:
    """Return whether a body is the ledge of a Roll trial."""
    return body.shape == "sphere" and body.scale[1] > LEDGE_LENGTH


def solid(name: str, points: np.ndarray) -> Shape:
    """Return a convex shape with these corners (K, 3)."""
    return Shape(name, hull(points), (convex(points),))


def ring(name: str, section: list[tuple[float, float]]) -> Shape:
    """Return a ring with this cross-section of (radius, height), divided as the pipe is."""
    mesh = revolve([(0.0, 0.0), (0.5, 0.0), (0.5, 1.0), (0.0, 1.0)], primitives.ROUND_SEGMENTS)
    pieces = ring_pieces([np.array(section)], primitives.PIPE_SECTORS, 1)
    return Shape(name, mesh, pieces, hollow=True)
