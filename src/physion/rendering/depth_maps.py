"""Depth maps of what lies between a surface and the light, or above the ground.

The shadow map looks along the directional light; it tells how much of that light reaches a point.
The occlusion map looks straight up from below; it tells how much of the sky over a point is hidden
by things that stand on the ground near it or hang low above it.

References
----------
Reeves, W., Salesin, D. and Cook, R. (1987). Rendering antialiased shadows with depth maps.
    SIGGRAPH.
Bunnell, M. (2005). Dynamic ambient occlusion and indirect lighting. GPU Gems 2.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]

BLOCK = 8
"""Texels along the side of a block of `DepthMap.occupied`."""
SHADOW_RADIUS = 2
"""Texels of the shadow map on each side of the nearest one that a lookup averages."""
SHADOW_AREA = float((2 * SHADOW_RADIUS + 1) * (2 * SHADOW_RADIUS + 1))
OCCLUSION_RADIUS = 3
"""Texels of the occlusion map on each side of the nearest one that a lookup averages."""
OCCLUSION_AREA = float((2 * OCCLUSION_RADIUS + 1) * (2 * OCCLUSION_RADIUS + 1))
OCCLUSION_REACH = 0.25
"""Metres above a point beyond which a thing does not darken it."""
OCCLUSION_TOLERANCE = 0.004
"""Metres by which a thing may lie lower than the point that it darkens."""


class DepthMap(NamedTuple):
    """Smallest depth of anything in each texel, by parallel projection.

    - ``matrix`` (3, 4) float64: from world (x, y, z, 1) to texel x, texel y, depth in metres.
    - ``depth`` (H, W) float32: metres; infinity where there is nothing.
    - ``occupied`` (H / BLOCK, W / BLOCK) bool: blocks of texels in which, or in a neighbour of
      which, there is anything. Elsewhere a lookup is skipped.
    """

    matrix: F64
    depth: F32
    occupied: NDArray[np.bool_]


@kernel
def lit_fraction(shadow: DepthMap, px: float, py: float, pz: float) -> float:
    """Return the fraction, 0..1, of the directional light that reaches a world point.

    Percentage-closer filtering (Reeves, Salesin and Cook 1987): the depth z of the point is
    compared with each texel near it, and the results are averaged,

        lit = sum of w_i [depth_i >= z] / sum of w_i.

    The window is 5 x 5 texels wide and centred on the point, not on a texel: of 6 x 6 texels the
    outer ones are weighted by the fraction that the window covers, so that shadows move smoothly.
    Outside the map everything is lit.
    """
    m, depth, occupied = shadow.matrix, shadow.depth, shadow.occupied
    x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3] - 0.5
    y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3] - 0.5
    low, high = -SHADOW_RADIUS, SHADOW_RADIUS + 1
    height, width = depth.shape
    if x < SHADOW_RADIUS or y < SHADOW_RADIUS or x >= width - high or y >= height - high:
        return 1.0
    j, i = int(x), int(y)
    if not occupied[i // BLOCK, j // BLOCK]:
        return 1.0
    z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
    ax, ay = x - j, y - i
    total = 0.0
    for row in range(low, high + 1):
        line = 0.0
        for column in range(low + 1, high):
            if depth[i + row, j + column] >= z:
                line += 1.0
        if depth[i + row, j + low] >= z:
            line += 1.0 - ax
        if depth[i + row, j + high] >= z:
            line += ax
        total += line * (1.0 - ay if row == low else (ay if row == high else 1.0))
    return float(total / SHADOW_AREA)


@kernel
def occluded_fraction(occlusion: DepthMap, px: float, py: float, pz: float) -> float:
    """Return how much of the surroundings of a world point is hidden by things above it, 0..1.

    Each texel near the point whose lowest thing is ``gap`` metres above it counts
    1 - gap / `OCCLUSION_REACH`, nothing beyond that reach; the result is the mean over a window of
    7 x 7 texels, centred on the point as in `lit_fraction`. It stands for the integral of hidden
    directions over the hemisphere (Bunnell 2005), of which nearer things hide more.
    """
    m, depth, occupied = occlusion.matrix, occlusion.depth, occlusion.occupied
    x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3] - 0.5
    y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3] - 0.5
    low, high = -OCCLUSION_RADIUS, OCCLUSION_RADIUS + 1
    height, width = depth.shape
    if x < OCCLUSION_RADIUS or y < OCCLUSION_RADIUS or x >= width - high or y >= height - high:
        return 0.0
    j, i = int(x), int(y)
    if not occupied[i // BLOCK, j // BLOCK]:
        return 0.0
    ax, ay = x - j, y - i
    total = 0.0
    for row in range(low, high + 1):
        line = 0.0
        for column in range(low, high + 1):
            gap = depth[i + row, j + column] - pz
            if -OCCLUSION_TOLERANCE < gap < OCCLUSION_REACH:
                weight = 1.0 - gap / OCCLUSION_REACH
                line += weight * (1.0 - ax if column == low else (ax if column == high else 1.0))
        total += line * (1.0 - ay if row == low else (ay if row == high else 1.0))
    return float(total / OCCLUSION_AREA)
