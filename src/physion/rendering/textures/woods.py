"""Painters of the textures of woods: figure, grain and pores."""

from __future__ import annotations

import numpy as np

from physion.numerics.elementary import exp, power, sin, tanh
from physion.rendering.textures.noise import F32, Painter, flat, grid, noise, tint


def _paint_ash(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint sawn ash: a trunk's rings cut lengthwise, with a pointed figure in the middle."""
    u, v = grid()
    warp = 0.026 * noise(rng, 2.5, 0.8) + 0.003 * noise(rng, 10, 2)
    depth = 0.10 + 0.16 * sin(2 * np.pi * (v + 0.1)) + 0.02 * noise(rng, 1.5, 2)
    away = (u - 0.06 + warp) % 1.0 - 0.5  # boards side by side mirror each other, without a seam
    rings = np.sqrt(away**2 + depth**2) * 58.0
    phase = rings - np.floor(rings)
    line = exp(-(((phase - 0.75) / 0.20) ** 2))
    pores = np.clip(noise(rng, 220, 8) - 0.6, 0, None)
    fade = np.clip(0.75 + 0.25 * noise(rng, 3, 2), 0.2, 1.2)
    streak = np.clip(0.85 + 0.45 * noise(rng, 200, 14), 0.1, 1.6)
    value = 0.95 - 0.40 * line * fade * streak - 0.07 * pores + 0.02 * noise(rng, 4, 2)
    return tint(np.clip(value, 0.05, 1.0), (0.98, 0.90, 0.76)), flat()


def _paint_cedar(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint red cedar glued from narrow staves, each cut from another board."""
    u, v = grid()
    staves = 5
    index = np.minimum((u * staves).astype(int), staves - 1)
    shade = np.array([0.82, 1.08, 0.70, 0.95, 1.15])[index]
    warp = 0.10 * noise(rng, 6, 1.2) + 0.7 * index
    phase = (u * 26 + warp * 6 + 0.5 * sin(2 * np.pi * (v + 0.31 * index))) % 1.0
    grain = exp(-(((phase - 0.5) / 0.22) ** 2))
    fibre = noise(rng, 160, 5)
    joint = np.abs(u * staves - np.round(u * staves)) < 0.018
    value = shade * (0.92 - 0.30 * grain + 0.05 * fibre) * np.where(joint, 0.55, 1.0)
    red = np.clip(value, 0.04, 1.4)
    color = np.stack([0.46 * red, 0.27 * power(red, 1.15), 0.20 * power(red, 1.2)], -1)
    return np.clip(color, 0, 1), flat()


def _paint_oak(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint quarter-sawn oak: straight grain, long dark pores, pale flecks across."""
    u, _ = grid()
    bands = sin(2 * np.pi * (16 * u + 0.35 * noise(rng, 3, 1.0)))
    pores = np.clip(noise(rng, 130, 9) - 0.9, 0, 1.5)
    flecks = np.clip(noise(rng, 14, 30) - 1.7, 0, 0.8)
    value = 0.74 + 0.07 * bands + 0.05 * noise(rng, 70, 3) - 0.32 * pores + 0.22 * flecks
    return tint(np.clip(value, 0.08, 1.0), (1.0, 0.88, 0.70)), flat()


def _paint_pine(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint pale pine: wide growth rings that bend around knots."""
    u, v = grid()
    bent, dark = np.zeros_like(u), np.zeros_like(u)
    for x, y, size in ((0.26, 0.3, 0.030), (0.71, 0.62, 0.038), (0.5, 0.93, 0.022)):
        du = (u - x + 0.5) % 1.0 - 0.5
        dv = ((v - y + 0.5) % 1.0 - 0.5) / 1.5
        away = np.sqrt(du**2 + dv**2) / size
        bent -= 2.2 * size * tanh(du / size) * exp(-((away / 2.4) ** 2))
        rings = 0.75 + 0.25 * sin(9.0 * away)
        dark = np.maximum(dark, rings * 0.5 * (1.0 - tanh(4.0 * (away - 1.0))))
    phase = (11 * (u + bent) + 0.4 * noise(rng, 2, 1.0)) % 1.0
    late = exp(-(((phase - 0.7) / 0.16) ** 2))
    value = 0.93 - 0.24 * late + 0.025 * noise(rng, 120, 5) + 0.02 * noise(rng, 3, 2)
    value = np.clip(value * (1.0 - 0.62 * dark), 0.05, 1.0)
    color = np.stack([value, 0.87 * power(value, 1.15), 0.66 * power(value, 1.45)], -1)
    return np.asarray(color, np.float32), flat()


def _paint_walnut(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint dark walnut: broad light and dark waves under fine streaks."""
    u, v = grid()
    flow = 5 * u + 0.22 * sin(2 * np.pi * v) + 0.5 * noise(rng, 2.0, 1.2)
    waves = sin(2 * np.pi * flow) + 0.5 * sin(2 * np.pi * (3 * flow + 0.2))
    fine = noise(rng, 90, 4)
    pores = np.clip(noise(rng, 150, 10) - 1.1, 0, 1.2)
    value = 0.40 + 0.13 * waves + 0.06 * fine - 0.14 * pores
    return tint(np.clip(value, 0.06, 1.0), (1.0, 0.80, 0.62)), flat()


WOOD_PAINTERS: dict[str, Painter] = {
    "wood_ash": _paint_ash,
    "wood_cedar": _paint_cedar,
    "wood_oak": _paint_oak,
    "wood_pine": _paint_pine,
    "wood_walnut": _paint_walnut,
}
