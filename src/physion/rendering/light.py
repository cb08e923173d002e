"""A room's light as arrays: its terms, where its shadows fall, and how light becomes bytes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.rendering.camera import View
from physion.rendering.rooms import Room
from physion.rendering.shading import BLOCK, TONES, WHITEST
from physion.scenes.scene import Scene, Vec3

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
    direction = np.asarray(room.lamp_direction)
    light = Light(
        lamp=np.stack([direction / np.linalg.norm(direction), room.lamp]),
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
    spots = spots[np.linalg.norm(spots[:, :2] - target, axis=1) < REACH]
    low = (spots[:, :2] - spots[:, 2:]).min(axis=0)
    high = (spots[:, :2] + spots[:, 2:]).max(axis=0)
    half = float(np.clip(0.5 * (high - low).max() + 1.0, 2.5, REACH + 1.0))
    return np.array([*0.5 * (low + high), 0.0]), half


def _lamp_rows(direction: F64) -> F64:
    """Axes (3, 3) of the lamp's picture: right, up, and away from the lamp."""
    toward = direction / np.linalg.norm(direction)
    right = np.cross((0.0, 1.0, 0.0), toward)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(toward, right), -toward])


def _empty_map(rows: F64, center: F64, half: float, texel: float) -> StillMap:
    size = BLOCK * int(np.ceil(2.0 * half / texel / BLOCK))
    matrix = np.zeros((3, 4))
    matrix[:2, :3] = rows[:2] / texel
    matrix[:2, 3] = 0.5 * size - matrix[:2, :3] @ center
    matrix[2, :3] = rows[2]
    return StillMap(matrix, np.full((size, size), np.inf, np.float32))


def _busy_blocks(depth: F32) -> NDArray[np.bool_]:
    """Which blocks of a depth map hold something, they or one of their eight neighbours."""
    rows, columns = (size // BLOCK for size in depth.shape)
    used = np.isfinite(depth).reshape(rows, BLOCK, columns, BLOCK).any(axis=(1, 3))
    wide = np.pad(used, 1)
    wide = wide[:-2] | wide[1:-1] | wide[2:]
    return np.asarray(wide[:, :-2] | wide[:, 1:-1] | wide[:, 2:])


def tone_table(exposure: float) -> U8:
    """Bytes of the picture for linear light 0..WHITEST: filmic shoulder, then the sRGB curve."""
    x = np.linspace(0.0, WHITEST, TONES) * exposure
    # Straight below the knee, then bending towards white without ever reaching it.
    knee = 0.55
    bent = knee + (1.0 - knee) * (1.0 - np.exp(-(x - knee) / (1.0 - knee)))
    y = np.where(x < knee, x, bent)
    curve = np.where(y <= 0.0031308, 12.92 * y, 1.055 * np.maximum(y, 1e-9) ** (1 / 2.4) - 0.055)
    return np.clip(np.round(255.0 * curve), 0, 255).astype(np.uint8)


def to_linear(color: Vec3) -> F64:
    """Linear light of an sRGB colour in 0..1, (3,)."""
    value = np.asarray(color, np.float64)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)
