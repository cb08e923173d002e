"""Procedural textures with their mip levels, and what each surface finish is made of.

A texture is a square of texels, each with a linear albedo factor (red, green, blue) that the
colour of a body multiplies, and the slope of its relief along u and v. Texels are bytes: the
square root of the albedo, so that dark wood keeps its shades, and slopes around 128.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.errors import UnknownNameError
from physion.rendering.textures.materials import MATERIAL_PAINTERS
from physion.rendering.textures.noise import SIZE, Painter
from physion.rendering.textures.room_surfaces import ROOM_PAINTERS
from physion.rendering.textures.woods import WOOD_PAINTERS
from physion.seeds import child_generator, named_seed

U8 = NDArray[np.uint8]

LEVELS = 10
SLOPE_SCALE = 64.0
"""Stored slope units for a relief that rises by one length over one length."""


@dataclass(frozen=True)
class Finish:
    """How a surface looks besides its colour.

    ``gloss`` is the strength and ``sharpness`` the exponent of the highlight; ``mirror`` the share
    of the surroundings that is reflected when looking straight on; ``metal`` tints reflections
    with the colour; ``relief`` scales the slopes of the texture.
    """

    texture: str
    gloss: float = 0.0
    sharpness: float = 20.0
    mirror: float = 0.0
    metal: float = 0.0
    relief: float = 0.0


PAINTERS: dict[str, Painter] = {**MATERIAL_PAINTERS, **ROOM_PAINTERS, **WOOD_PAINTERS}
FINISHES = {
    "plain": Finish("plain", gloss=0.05, sharpness=20.0, mirror=0.01),
    "wood_ash": Finish("wood_ash", gloss=0.04, sharpness=24.0, mirror=0.008),
    "wood_cedar": Finish("wood_cedar", gloss=0.06, sharpness=24.0, mirror=0.012),
    "wood_oak": Finish("wood_oak", gloss=0.06, sharpness=24.0, mirror=0.012),
    "wood_pine": Finish("wood_pine", gloss=0.04, sharpness=24.0, mirror=0.008),
    "wood_walnut": Finish("wood_walnut", gloss=0.14, sharpness=40.0, mirror=0.025),
    "metal": Finish("metal", gloss=0.5, sharpness=40.0, mirror=0.5, metal=1.0),
    "metal_brushed": Finish("metal_brushed", gloss=0.55, sharpness=14.0, mirror=0.55, metal=1.0),
    "metal_cast": Finish("metal_cast", gloss=0.25, sharpness=10.0, mirror=0.16, metal=0.6),
    "metal_hammered": Finish("metal_hammered", gloss=0.8, sharpness=24.0, mirror=0.6, metal=1.0),
    "metal_polished": Finish("plain", gloss=1.6, sharpness=160.0, mirror=0.8, metal=1.0),
    "plastic": Finish("plain", gloss=0.30, sharpness=60.0, mirror=0.04),
    "plastic_glossy": Finish("plain", gloss=0.85, sharpness=180.0, mirror=0.10),
    "plastic_matte": Finish("plastic_matte", gloss=0.10, sharpness=12.0, mirror=0.015),
    "plastic_speckled": Finish("plastic_speckled", gloss=0.35, sharpness=80.0, mirror=0.05),
    "stone_granite": Finish("stone_granite", gloss=0.35, sharpness=90.0, mirror=0.04),
    "stone_marble": Finish("stone_marble", gloss=0.55, sharpness=120.0, mirror=0.06),
    "stone_sandstone": Finish("stone_sandstone"),
    "stone_slate": Finish("stone_slate", gloss=0.10, sharpness=16.0, mirror=0.015),
    "cloth": Finish("cloth", gloss=0.35, sharpness=14.0, mirror=0.03),
    "fabric_canvas": Finish("fabric_canvas"),
    "fabric_denim": Finish("fabric_denim"),
    "fabric_linen": Finish("fabric_linen"),
    "fabric_wool": Finish("fabric_wool"),
    "moon": Finish("moon", gloss=0.05, sharpness=20.0),
    "wicker": Finish("wicker", gloss=0.05, sharpness=20.0),
    "fur": Finish("fur", gloss=0.05, sharpness=10.0),
    "carpet": Finish("carpet", relief=1.0),
    "plaster": Finish("plaster", relief=1.0),
    "smooth_plaster": Finish("smooth_plaster", relief=1.0),
    "tiles": Finish("tiles", gloss=0.08, sharpness=60.0, mirror=0.014, relief=0.2),
    "planks": Finish("wood_ash", gloss=0.05),
    "paving": Finish("paving", relief=0.0),
    "glow": Finish("plain"),
}
"""Finishes by the name that `physion.scenes.scene.Look.texture` gives. The last ones are for
rooms."""


def finish(name: str) -> Finish:
    """The finish called ``name``; `UnknownNameError` with the closest names otherwise."""
    if name not in FINISHES:
        raise UnknownNameError("texture", name, FINISHES)
    return FINISHES[name]


class Atlas(NamedTuple):
    """Textures with all levels, one after the other, as the shading loop reads them.

    ``texels`` (N, 5) bytes; ``starts`` (textures, LEVELS): first texel of each level, whose side
    is ``SIZE >> level``.
    """

    texels: U8
    starts: NDArray[np.int64]


@lru_cache(maxsize=8)
def build_atlas(names: tuple[str, ...]) -> Atlas:
    """Stack the named textures; equal names give the same arrays."""
    levels = [level for name in names for level in _levels(name)]
    sizes = np.array([len(level) for level in levels])
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]).reshape(len(names), LEVELS)
    return Atlas(np.concatenate(levels), starts.astype(np.int64))


@lru_cache(maxsize=64)
def _levels(name: str) -> tuple[U8, ...]:
    """Return the mip levels of one texture, each (side * side, 5) bytes, means of linear light."""
    seed = named_seed(name)
    albedo, height = PAINTERS[name](child_generator(seed, "painting"))
    image = np.empty((5, SIZE, SIZE), np.float32)
    image[:3] = np.moveaxis(albedo, -1, 0)
    image[3] = (np.roll(height, -1, 1) - np.roll(height, 1, 1)) * (SIZE / 2)
    image[4] = (np.roll(height, -1, 0) - np.roll(height, 1, 0)) * (SIZE / 2)
    levels = []
    for _ in range(LEVELS):
        stored = np.empty_like(image)
        np.multiply(np.sqrt(image[:3]), 255.0, out=stored[:3])
        np.multiply(image[3:], SLOPE_SCALE, out=stored[3:])
        stored[3:] += 128.0
        stored += 0.5
        np.clip(stored, 0.0, 255.0, out=stored)
        levels.append(np.moveaxis(stored.astype(np.uint8), 0, -1).reshape(-1, 5))
        if image.shape[1] > 1:
            rows = image[:, ::2] + image[:, 1::2]
            image = np.float32(0.25) * (rows[:, :, ::2] + rows[:, :, 1::2])
    return tuple(levels)
