"""Texture lookup: mip level of a pixel's footprint, and filtering within and between levels.

A texture is stored as a pyramid of levels, each a square of texels with half the side of the one
before (mip map, Williams 1983). A texel holds five bytes: the square roots of the linear albedo in
red, green and blue, and the slopes of the surface along u and v.

References
----------
Williams, L. (1983). Pyramidal parametrics. SIGGRAPH.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import coarse_log2_of
from physion.numerics.kernel import kernel

I64 = NDArray[np.int64]
U8 = NDArray[np.uint8]

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


@kernel
def mip_level(footprint: float, side: int) -> float:
    """Return the mip level at which a pixel covers one texel; 0 is the finest.

    ``footprint`` is the area of the pixel as a fraction of the texture, ``side`` the texels along
    the side of level 0. A texel of level l has the area 4^l / side^2, so
    l = log2(side^2 footprint) / 2, and 0 for a pixel smaller than a texel (Williams 1983).
    """
    return 0.5 * coarse_log2_of(max(side * side * footprint, 1.0))


@kernel
def _bilinear(
    texels: U8, start: int, side: int, u: float, v: float
) -> tuple[float, float, float, float, float]:
    """Return the stored values of one level between its four nearest texels; it repeats."""
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
    p = wi * texels[i, 3] + wj * texels[j, 3] + wk * texels[k, 3] + wm * texels[m, 3]
    q = wi * texels[i, 4] + wj * texels[j, 4] + wk * texels[k, 4] + wm * texels[m, 4]
    return r, g, b, p, q


@kernel
def sample_texture(
    atlas: Atlas, texture: int, u: float, v: float, level: float
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

    Returns
    -------
    tuple of float
        Linear albedo (red, green, blue) in 0..1, slopes of the surface along u and v.
    """
    levels = atlas.starts.shape[1]
    fine = min(int(level), levels - 1)
    weight = level - fine
    side = 1 << (levels - 1)
    r, g, b, p, q = _bilinear(atlas.texels, atlas.starts[texture, fine], side >> fine, u, v)
    if weight > NEGLIGIBLE_WEIGHT and fine + 1 < levels:
        start = atlas.starts[texture, fine + 1]
        r1, g1, b1, p1, q1 = _bilinear(atlas.texels, start, side >> (fine + 1), u, v)
        r, g, b = r + weight * (r1 - r), g + weight * (g1 - g), b + weight * (b1 - b)
        p, q = p + weight * (p1 - p), q + weight * (q1 - q)
    unit = 1.0 / (ALBEDO_SCALE * ALBEDO_SCALE)
    slope_u, slope_v = (p - SLOPE_ZERO) / SLOPE_SCALE, (q - SLOPE_ZERO) / SLOPE_SCALE
    return r * r * unit, g * g * unit, b * b * unit, slope_u, slope_v
