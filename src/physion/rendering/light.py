"""A room's light as arrays for the colour pass, its empty depth maps, and the tone curve."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.numerics.elementary import exp, power
from physion.numerics.linear_algebra import apply, norm, unit
from physion.rendering.rasterizer import (
    BLOCK,
    LIGHT,
    DepthMap,
    Records,
    bound_blocks,
    mark_lookups,
    mark_neighbours,
    rasterize_depth,
    restore_blocks,
    transform,
)
from physion.rendering.rooms import Room
from physion.rendering.shading import TONES, WHITEST
from physion.scenes.scene import Scene

F64 = NDArray[np.float64]
I32 = NDArray[np.int32]
U8 = NDArray[np.uint8]

SHADOW_TEXEL = 0.016
"""Metres that a texel of the shadow map spans."""
OCCLUSION_TEXEL = 0.03
"""Metres that a texel of the occlusion map spans."""
MAP_REACH = 5.0
"""Metres around the point that the camera looks at within which objects throw shadows."""
MAP_MARGIN = 1.0
"""Metres of the depth maps around the outermost object."""
SMALLEST_MAP = 2.5
"""Smallest half size of the depth maps in metres."""
KNEE = 0.55
"""Linear light up to which the tone curve is a straight line."""
SRGB_LINEAR_END, SRGB_LINEAR_SLOPE = 0.0031308, 12.92
"""Linear light up to which the sRGB curve is a straight line, and its slope (IEC 61966-2-1)."""
SRGB_CODED_END = 0.04045
"""Coded value at the end of that line."""
SRGB_OFFSET, SRGB_GAMMA = 0.055, 2.4
"""Offset and exponent of the sRGB curve beyond the line."""


class StaticDepthMap:
    """A `DepthMap` of what never moves, and a working copy for the moving bodies of one frame.

    Parameters
    ----------
    matrix
        As in `DepthMap`.
    size
        Texels along each side, a multiple of `BLOCK`.
    """

    def __init__(self, matrix: F64, size: int) -> None:
        self.matrix = matrix
        self._static = np.full((size, size), np.inf, np.float32)
        self._depth = self._static.copy()
        self._drawn = np.zeros((size // BLOCK, size // BLOCK), np.bool_)
        self._occupied = np.zeros_like(self._drawn)
        self._bounds = np.full((*self._drawn.shape, 2), np.inf, np.float32)
        self._texels = np.zeros((0, 3))

    def draw_static(self, vertices: F64, faces: I32, first: int, last: int) -> None:
        """Draw the triangles ``first:last`` of what never moves; vertices (V, 3) in the world."""
        drawn = np.zeros_like(self._drawn)
        self._texels = np.empty_like(vertices)
        transform(self.matrix, vertices, 0, self._texels)
        rasterize_depth(self._texels, faces, first, last, self._static, drawn)
        mark_neighbours(drawn, self._occupied)
        bound_blocks(self._static, drawn, self._bounds)
        self._depth[...] = self._static

    def with_moving(self, vertices: F64, first_vertex: int, faces: I32, first: int) -> DepthMap:
        """Return the map of one frame; the next call changes its ``depth``.

        Parameters
        ----------
        vertices, first_vertex
            (V, 3) in the world, and the first of them that moves.
        faces, first
            (T, 3) vertex indices, and the first triangle that moves.
        """
        restore_blocks(self._static, self._depth, self._drawn)
        transform(self.matrix, vertices, first_vertex, self._texels)
        rasterize_depth(self._texels, faces, first, len(faces), self._depth, self._drawn)
        occupied, bounds = self._occupied.copy(), self._bounds.copy()
        moved = np.zeros_like(self._drawn)
        mark_neighbours(self._drawn, occupied)
        mark_lookups(self._drawn, moved)
        bound_blocks(self._depth, self._drawn, bounds)
        return DepthMap(self.matrix, self._depth, occupied, moved.reshape(-1), bounds)


def empty_maps(scene: Scene, room: Room) -> tuple[StaticDepthMap, StaticDepthMap]:
    """Return the shadow map and the occlusion map of a scene with nothing in them."""
    center, half = _mapped_region(scene)
    light_axes = _light_axes(np.asarray(room.light_direction, np.float64))
    return (
        _empty_map(light_axes, center, half, SHADOW_TEXEL),
        _empty_map(np.eye(3), center, half, OCCLUSION_TEXEL),
    )


def pack_light(room: Room) -> Records:
    """Return the light of a room as one record of `physion.rendering.rasterizer.LIGHT`, (1,)."""
    light = np.zeros(1, LIGHT)
    light["direction"] = unit(room.light_direction)
    light["color"] = room.light_color
    light["ambient"], light["ambient_slopes"] = room.ambient, room.ambient_slopes
    light["environment"] = room.environment
    light["window_low"], light["window_high"], light["window_color"] = room.window
    light["room_low"], light["room_high"] = room.low, room.high
    light["background"] = to_linear(room.background)
    light["shadow_strength"] = room.shadow_strength
    light["occlusion_strength"] = room.occlusion_strength
    return light


def _mapped_region(scene: Scene) -> tuple[F64, float]:
    """Return centre on the ground and half size in metres of the region of the depth maps.

    It holds all objects that start within `MAP_REACH` of the point that the camera looks at. It
    depends on the scene only, so that no frame depends on other frames.
    """
    objects = [(*body.position[:2], max(body.scale)) for body in scene.bodies]
    objects += [(*cloth.position[:2], max(cloth.size)) for cloth in scene.cloths]
    target = np.array(scene.camera.target[:2])
    circles = np.array([[*target, 0.0], *objects])
    circles = circles[norm(circles[:, :2] - target) < MAP_REACH]
    low = (circles[:, :2] - circles[:, 2:]).min(axis=0)
    high = (circles[:, :2] + circles[:, 2:]).max(axis=0)
    half = 0.5 * (high - low).max() + MAP_MARGIN
    center = np.array([*0.5 * (low + high), 0.0])
    return center, float(np.clip(half, SMALLEST_MAP, MAP_REACH + MAP_MARGIN))


def _light_axes(direction: F64) -> F64:
    """Return the axes (3, 3) of the shadow map: right, up, and away from the light."""
    toward = unit(direction)
    right = unit(np.cross((0.0, 1.0, 0.0), toward))
    return np.stack([right, np.cross(toward, right), -toward])


def _empty_map(axes: F64, center: F64, half: float, texel: float) -> StaticDepthMap:
    """Return a map without objects.

    Parameters
    ----------
    axes
        (3, 3) unit vectors of the map's x, y and depth in the world.
    center, half
        Point (3,) in the middle of the map, and half its size, in metres.
    texel
        Metres that a texel spans.
    """
    size = BLOCK * int(np.ceil(2.0 * half / texel / BLOCK))
    matrix = np.zeros((3, 4))
    matrix[:2, :3] = axes[:2] / texel
    matrix[:2, 3] = 0.5 * size - apply(matrix[:2, :3], center)
    matrix[2, :3] = axes[2]
    return StaticDepthMap(matrix, size)


@lru_cache(maxsize=16)
def tone_table(exposure: float) -> U8:
    """Return the sRGB bytes (TONES,) of linear light from 0 to `WHITEST`.

    The tone curve is x up to the knee k = `KNEE` and k + (1 - k) (1 - exp(-(x - k) / (1 - k)))
    beyond: its slope is continuous, and it tends to white without reaching it. ``exposure``
    multiplies the light first; the sRGB curve follows.
    """
    x = np.linspace(0.0, WHITEST, TONES) * exposure
    shoulder = KNEE + (1.0 - KNEE) * (1.0 - exp(-(x - KNEE) / (1.0 - KNEE)))
    y = np.where(x < KNEE, x, shoulder)
    bent = (1.0 + SRGB_OFFSET) * power(np.maximum(y, 1e-9), 1 / SRGB_GAMMA) - SRGB_OFFSET
    curve = np.where(y <= SRGB_LINEAR_END, SRGB_LINEAR_SLOPE * y, bent)
    return np.clip(np.round(255.0 * curve), 0, 255).astype(np.uint8)


def to_linear(colors: ArrayLike) -> F64:
    """Return the linear light (..., 3) of sRGB colours (..., 3) in 0..1."""
    value = np.asarray(colors, np.float64)
    bent = power((value + SRGB_OFFSET) / (1.0 + SRGB_OFFSET), SRGB_GAMMA)
    return np.where(value <= SRGB_CODED_END, value / SRGB_LINEAR_SLOPE, bent)
