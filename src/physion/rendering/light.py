"""A room's light as arrays: its terms, where its shadows fall, and how light becomes bytes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.numerics.elementary import exp, power
from physion.numerics.linear_algebra import apply, norm, unit
from physion.rendering.camera import View
from physion.rendering.rooms import Room
from physion.rendering.shading import BLOCK, TONES, WHITEST
from physion.scenes.scene import Scene

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
U8 = NDArray[np.uint8]

SHADOW_TEXEL = 0.016
CONTACT_TEXEL = 0.03
"""Metres that a texel of the shadow map and of the contact map spans."""
LIFT = 0.03
"""Metres off its surface at which a point asks whether it is in shadow."""
REACH = 5.0
"""Metres around what the camera looks at within which things throw shadows."""
CONTACT_REACH = 0.25
"""Metres above the ground below which a thing darkens it."""


class Light(NamedTuple):
    """A room's light; linear colours.

    - ``lamp`` (2, 3): unit vector to the lamp, its colour.
    - ``around`` (4, 3): light from all sides: constant, and slopes along x, y and z.
    - ``mirrored`` (3, 3): what glossy things reflect: from the sides, from below, from above.
    - ``window`` (3, 3): lowest and highest corner of a bright rectangle in a plane of one y, and
      its colour: glossy things reflect it with soft edges.
    - ``bounds`` (2, 3): lowest and highest corner of the room, darker near its edges.
    """

    lamp: F64
    around: F64
    mirrored: F64
    window: F64
    bounds: F64


class ShadeMap(NamedTuple):
    """A depth map of what stands in the light's way.

    ``matrix`` (3, 4): world to texel x, texel y, depth in metres. ``depth`` (H, W): the smallest
    depth of anything there. ``busy``: for each `BLOCK` x `BLOCK` texels, whether there is anything
    in them or in their neighbours; elsewhere nothing needs looking up.
    """

    matrix: F64
    depth: F32
    busy: NDArray[np.bool_]


class StillMap(NamedTuple):
    """The part of a `ShadeMap` that is the same in every frame: what never moves."""

    matrix: F64
    depth: F32

    def with_moving(self, depth: F32) -> ShadeMap:
        """The whole map, from a copy of ``depth`` in which the moving things are drawn too."""
        return ShadeMap(self.matrix, depth, _busy_blocks(depth))


def still_maps(scene: Scene, room: Room) -> tuple[StillMap, StillMap]:
    """Empty shadow and contact maps for a scene."""
    center, half = _region(scene)
    lamp = _lamp_rows(np.asarray(room.lamp_direction, np.float64))
    return (
        _empty_map(lamp, center, half, SHADOW_TEXEL),
        _empty_map(np.eye(3), center, half, CONTACT_TEXEL),
    )


def pack_light(room: Room, view: View) -> tuple[F64, F64, F64]:
    """The camera, the light and its settings as `shade` reads them."""
    light = Light(
        lamp=np.stack([unit(room.lamp_direction), room.lamp]),
        around=np.asarray(room.around),
        mirrored=np.asarray(room.mirrored),
        window=np.asarray(room.window),
        bounds=np.asarray([room.low, room.high]),
    )
    background = to_linear(room.background)[None]
    sight = np.concatenate([np.asarray(view.camera.position)[None], view.ray_matrix])
    settings = np.array([LIFT, room.shadow, room.contact, CONTACT_REACH])
    return sight, np.concatenate([*light, background]), settings


def _region(scene: Scene) -> tuple[F64, float]:
    """Centre on the ground and half size in metres of where shadows fall.

    It holds what begins within `REACH` of what the camera looks at, and depends on the scene
    alone, so that a frame does not depend on the frames after it.
    """
    at = [(*body.position[:2], max(body.scale)) for body in scene.bodies]
    at += [(*cloth.position[:2], max(cloth.size)) for cloth in scene.cloths]
    target = np.array(scene.camera.target[:2])
    spots = np.array([[*target, 0.0], *at])
    spots = spots[norm(spots[:, :2] - target) < REACH]
    low = (spots[:, :2] - spots[:, 2:]).min(axis=0)
    high = (spots[:, :2] + spots[:, 2:]).max(axis=0)
    half = float(np.clip(0.5 * (high - low).max() + 1.0, 2.5, REACH + 1.0))
    return np.array([*0.5 * (low + high), 0.0]), half


def _lamp_rows(direction: F64) -> F64:
    """Return the axes (3, 3) of the lamp's picture: right, up, and away from the lamp."""
    toward = unit(direction)
    right = unit(np.cross((0.0, 1.0, 0.0), toward))
    return np.stack([right, np.cross(toward, right), -toward])


def _empty_map(rows: F64, center: F64, half: float, texel: float) -> StillMap:
    size = BLOCK * int(np.ceil(2.0 * half / texel / BLOCK))
    matrix = np.zeros((3, 4))
    matrix[:2, :3] = rows[:2] / texel
    matrix[:2, 3] = 0.5 * size - apply(matrix[:2, :3], center)
    matrix[2, :3] = rows[2]
    return StillMap(matrix, np.full((size, size), np.inf, np.float32))


def _busy_blocks(depth: F32) -> NDArray[np.bool_]:
    """Which blocks of a depth map hold something, they or one of their eight neighbours."""
    rows, columns = (size // BLOCK for size in depth.shape)
    used = np.isfinite(depth).reshape(rows, BLOCK, -1).any(axis=1)
    used = used.reshape(rows, columns, BLOCK).any(axis=2)
    wide = np.pad(used, 1)
    wide = wide[:-2] | wide[1:-1] | wide[2:]
    return np.asarray(wide[:, :-2] | wide[:, 1:-1] | wide[:, 2:])


def tone_table(exposure: float) -> U8:
    """Return the bytes of linear light 0..WHITEST: a filmic shoulder, then the sRGB curve."""
    x = np.linspace(0.0, WHITEST, TONES) * exposure
    # Straight below the knee, then bending towards white without ever reaching it.
    knee = 0.55
    bent = knee + (1.0 - knee) * (1.0 - exp(-(x - knee) / (1.0 - knee)))
    y = np.where(x < knee, x, bent)
    curve = np.where(y <= 0.0031308, 12.92 * y, 1.055 * power(np.maximum(y, 1e-9), 1 / 2.4) - 0.055)
    return np.clip(np.round(255.0 * curve), 0, 255).astype(np.uint8)


def to_linear(colors: ArrayLike) -> F64:
    """Return the linear light (..., 3) of sRGB colours (..., 3) in 0..1."""
    value = np.asarray(colors, np.float64)
    return np.where(value <= 0.04045, value / 12.92, power((value + 0.055) / 1.055, 2.4))
