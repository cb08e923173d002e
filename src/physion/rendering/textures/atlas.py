"""Procedural textures with their mip levels, and the table of surface finishes.

A texture is a square of texels. Each has a linear albedo (red, green, blue), which is multiplied
with the colour of a body, and the slopes of the surface along u and v for normal mapping. Texels
are bytes; the square root of the albedo is stored, so that dark wood keeps its shades.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import UnknownNameError
from physion.core.seeds import child_generator, named_seed
from physion.numerics.elementary import coarse_log2_of
from physion.numerics.kernel import in_place_kernel
from physion.rendering.textures.materials import (
    MATERIAL_PAINTERS,
    ROOM_PAINTERS,
    SIZE,
    WOOD_PAINTERS,
    Painter,
)

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]


# Texture lookup: mip level of a pixel's footprint, and filtering within and between levels.
#
# A texture is stored as a pyramid of levels, each a square of texels with half the side of the one
# before (mip map, Williams 1983). A texel holds five bytes: the square roots of the linear albedo
# in red, green and blue, and the slopes of the surface along u and v.
#
# References
# ----------
# Williams, L. (1983). Pyramidal parametrics. SIGGRAPH.

ALBEDO_SCALE = 255.0
"""Stored value of a square root of albedo of 1."""
SLOPE_SCALE = 64.0
"""Difference of stored values for a slope of 1."""
SLOPE_ZERO = 128.0
"""Stored value of a slope of 0."""
NEGLIGIBLE_WEIGHT = 0.02
"""Weight up to which the coarser of two levels is left out."""


class Atlas(NamedTuple):
    """Textures with all levels, one after the other.

    - ``texels`` (N, 5) uint8: square roots of the albedo (red, green, blue), slopes along u and v.
    - ``starts`` (textures, levels) int64: first texel of each level. The side of level l is
      ``1 << (levels - 1 - l)``; the last level is a single texel.
    """

    texels: U8
    starts: I64


@in_place_kernel
def mip_level(footprint: float, side: int) -> float:
    """Return the mip level at which a pixel covers one texel; 0 is the finest.

    ``footprint`` is the area of the pixel as a fraction of the texture, ``side`` the texels along
    the side of level 0. A texel of level l has the area 4^l / side^2, so
    l = log2(side^2 footprint) / 2, and 0 for a pixel smaller than a texel (Williams 1983).
    """
    return 0.5 * coarse_log2_of(max(side * side * footprint, 1.0))


@in_place_kernel
def _bilinear(
    texels: U8, start: int, side: int, u: float, v: float, slopes: bool
) -> tuple[float, float, float, float, float]:
    """Return the stored values of one level between its four nearest texels; it repeats.

    Without ``slopes`` the last two are 0.
    """
    x, y = u * side - 0.5, v * side - 0.5
    fx, fy = np.floor(x), np.floor(y)
    ax, ay = x - fx, y - fy
    mask = side - 1
    x0, y0 = int(fx) & mask, int(fy) & mask
    x1, y1 = (x0 + 1) & mask, (y0 + 1) & mask
    i, j = start + y0 * side + x0, start + y0 * side + x1
    k, m = start + y1 * side + x0, start + y1 * side + x1
    wi, wj, wk, wm = (1 - ax) * (1 - ay), ax * (1 - ay), (1 - ax) * ay, ax * ay
    r = wi * texels[i, 0] + wj * texels[j, 0] + wk * texels[k, 0] + wm * texels[m, 0]
    g = wi * texels[i, 1] + wj * texels[j, 1] + wk * texels[k, 1] + wm * texels[m, 1]
    b = wi * texels[i, 2] + wj * texels[j, 2] + wk * texels[k, 2] + wm * texels[m, 2]
    p, q = 0.0, 0.0
    if slopes:
        p = wi * texels[i, 3] + wj * texels[j, 3] + wk * texels[k, 3] + wm * texels[m, 3]
        q = wi * texels[i, 4] + wj * texels[j, 4] + wk * texels[k, 4] + wm * texels[m, 4]
    return r, g, b, p, q


@in_place_kernel
def sample_texture(
    atlas: Atlas, texture: int, u: float, v: float, level: float, slopes: bool
) -> tuple[float, float, float, float, float]:
    """Look up a texture with trilinear filtering (Williams 1983).

    Parameters
    ----------
    atlas, texture
        The textures, and the index of one of them.
    u, v
        Texture coordinates; the texture repeats every unit.
    level
        Mip level, 0 or more; between two whole levels their values are mixed linearly.
    slopes
        Whether the slopes are looked up; otherwise they have no meaning.

    Returns
    -------
    tuple of float
        Linear albedo (red, green, blue) in 0..1, slopes of the surface along u and v.
    """
    levels = atlas.starts.shape[1]
    fine = min(int(level), levels - 1)
    weight = level - fine
    side = 1 << (levels - 1)
    r, g, b, p, q = _bilinear(atlas.texels, atlas.starts[texture, fine], side >> fine, u, v, slopes)
    if weight > NEGLIGIBLE_WEIGHT and fine + 1 < levels:
        start = atlas.starts[texture, fine + 1]
        r1, g1, b1, p1, q1 = _bilinear(atlas.texels, start, side >> (fine + 1), u, v, slopes)
        r, g, b = r + weight * (r1 - r), g + weight * (g1 - g), b + weight * (b1 - b)
        p, q = p + weight * (p1 - p), q + weight * (q1 - q)
    unit = 1.0 / (ALBEDO_SCALE * ALBEDO_SCALE)
    slope_u, slope_v = (p - SLOPE_ZERO) / SLOPE_SCALE, (q - SLOPE_ZERO) / SLOPE_SCALE
    return r * r * unit, g * g * unit, b * b * unit, slope_u, slope_v


LEVELS = 10
"""Mip levels of a texture: sides `SIZE`, `SIZE` / 2, ..., 1."""


@dataclass(frozen=True)
class Finish:
    """How a surface looks apart from its colour.

    - ``texture``: name in `PAINTERS`.
    - ``specular``, ``exponent``: strength and exponent of the Blinn-Phong highlight.
    - ``reflectance``: fraction of the environment that is reflected seen straight on.
    - ``metalness``: 0..1; reflections of a metal have the colour of its albedo.
    - ``normal_scale``: factor of the texture's slopes in the normal map.
    """

    texture: str
    specular: float = 0.0
    exponent: float = 20.0
    reflectance: float = 0.0
    metalness: float = 0.0
    normal_scale: float = 0.0


PAINTERS: dict[str, Painter] = {**MATERIAL_PAINTERS, **ROOM_PAINTERS, **WOOD_PAINTERS}
FINISHES = {
    "plain": Finish("plain", specular=0.05, exponent=20.0, reflectance=0.01),
    "wood_ash": Finish("wood_ash", specular=0.04, exponent=24.0, reflectance=0.008),
    "wood_cedar": Finish("wood_cedar", specular=0.06, exponent=24.0, reflectance=0.012),
    "wood_oak": Finish("wood_oak", specular=0.06, exponent=24.0, reflectance=0.012),
    "wood_pine": Finish("wood_pine", specular=0.04, exponent=24.0, reflectance=0.008),
    "wood_walnut": Finish("wood_walnut", specular=0.14, exponent=40.0, reflectance=0.025),
    "metal": Finish("metal", specular=0.5, exponent=40.0, reflectance=0.5, metalness=1.0),
    "metal_brushed": Finish(
        "metal_brushed", specular=0.55, exponent=14.0, reflectance=0.55, metalness=1.0
    ),
    "metal_cast": Finish(
        "metal_cast", specular=0.25, exponent=10.0, reflectance=0.16, metalness=0.6
    ),
    "metal_hammered": Finish(
        "metal_hammered", specular=0.8, exponent=24.0, reflectance=0.6, metalness=1.0
    ),
    "metal_polished": Finish("plain", specular=1.6, exponent=160.0, reflectance=0.8, metalness=1.0),
    "plastic": Finish("plain", specular=0.30, exponent=60.0, reflectance=0.04),
    "plastic_glossy": Finish("plain", specular=0.85, exponent=180.0, reflectance=0.10),
    "plastic_matte": Finish("plastic_matte", specular=0.10, exponent=12.0, reflectance=0.015),
    "plastic_speckled": Finish("plastic_speckled", specular=0.35, exponent=80.0, reflectance=0.05),
    "stone_granite": Finish("stone_granite", specular=0.35, exponent=90.0, reflectance=0.04),
    "stone_marble": Finish("stone_marble", specular=0.55, exponent=120.0, reflectance=0.06),
    "stone_sandstone": Finish("stone_sandstone"),
    "stone_slate": Finish("stone_slate", specular=0.10, exponent=16.0, reflectance=0.015),
    "cloth": Finish("cloth", specular=0.35, exponent=14.0, reflectance=0.03),
    "fabric_canvas": Finish("fabric_canvas"),
    "fabric_denim": Finish("fabric_denim"),
    "fabric_linen": Finish("fabric_linen"),
    "fabric_wool": Finish("fabric_wool"),
    "moon": Finish("moon", specular=0.05, exponent=20.0),
    "wicker": Finish("wicker", specular=0.05, exponent=20.0),
    "fur": Finish("fur", specular=0.05, exponent=10.0),
    "carpet": Finish("carpet", normal_scale=1.0),
    "plaster": Finish("plaster", normal_scale=1.0),
    "smooth_plaster": Finish("smooth_plaster", normal_scale=1.0),
    "tiles": Finish("tiles", specular=0.08, exponent=60.0, reflectance=0.014, normal_scale=0.2),
    "planks": Finish("wood_ash", specular=0.05),
    "paving": Finish("paving", normal_scale=0.0),
    "glow": Finish("plain"),
}
"""Finishes by the name in `physion.scenes.scene.Look.texture`. Those from "carpet" on are for
rooms."""


def finish(name: str) -> Finish:
    """Return the finish called ``name``; raise `UnknownNameError` if there is none."""
    if name not in FINISHES:
        raise UnknownNameError("texture", name, FINISHES)
    return FINISHES[name]


@lru_cache(maxsize=8)
def build_atlas(names: tuple[str, ...]) -> Atlas:
    """Return the named textures, one after the other; equal names give the same arrays."""
    levels = [level for name in names for level in _levels(name)]
    sizes = np.array([len(level) for level in levels])
    starts = np.concatenate([[0], np.cumsum(sizes)[:-1]]).reshape(len(names), LEVELS)
    return Atlas(np.concatenate(levels), starts.astype(np.int64))


@lru_cache(maxsize=64)
def _levels(name: str) -> tuple[U8, ...]:
    """Return the mip levels of a texture, each (side * side, 5) bytes.

    A texel is the mean of four texels of the level before, in linear albedo. The slopes are
    central differences of the height.
    """
    seed = named_seed(name)
    albedo, height = PAINTERS[name](child_generator(seed, "painting"))
    image = np.empty((5, SIZE, SIZE), np.float32)
    image[:3] = np.moveaxis(albedo, -1, 0)
    image[3] = (np.roll(height, -1, 1) - np.roll(height, 1, 1)) * (SIZE / 2)
    image[4] = (np.roll(height, -1, 0) - np.roll(height, 1, 0)) * (SIZE / 2)
    levels = []
    for _ in range(LEVELS):
        stored = np.empty_like(image)
        np.multiply(np.sqrt(image[:3]), ALBEDO_SCALE, out=stored[:3])
        np.multiply(image[3:], SLOPE_SCALE, out=stored[3:])
        stored[3:] += SLOPE_ZERO
        stored += 0.5  # the conversion to bytes truncates
        np.clip(stored, 0.0, 255.0, out=stored)
        levels.append(np.moveaxis(stored.astype(np.uint8), 0, -1).reshape(-1, 5))
        if image.shape[1] > 1:
            rows = image[:, ::2] + image[:, 1::2]
            image = np.float32(0.25) * (rows[:, :, ::2] + rows[:, :, 1::2])
    return tuple(levels)
