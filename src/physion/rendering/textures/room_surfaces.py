"""Painters of the textures of rooms: carpet, plaster, tiles, paving."""

from __future__ import annotations

import numpy as np

from physion.numerics.elementary import exp, power, sin
from physion.rendering.textures.noise import F32, Painter, flat, grid, noise, tint, uniform


def _paint_carpet(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint loops of wool in rows, some of them paler."""
    u, v = grid()
    rows = sin(2 * np.pi * 70 * v) * sin(2 * np.pi * (70 * u + 0.5 * np.floor(70 * v)))
    fleck = noise(rng, 110, 90)
    height = 0.3 * rows + 0.8 * fleck + 0.4 * noise(rng, 45, 36)
    value = 0.52 * exp(0.48 * height + 0.03 * noise(rng, 4, 4))
    return np.clip(tint(value, (1.0, 1.0, 1.0)), 0.02, 1), 0.0002 * height


def _paint_plaster(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint trowelled plaster: broad strokes and grit."""
    strokes = noise(rng, 8, 26) + 0.6 * noise(rng, 34, 16)
    grit = noise(rng, 120, 120)
    value = 0.90 + 0.012 * strokes + 0.008 * grit + 0.015 * noise(rng, 2, 2)
    return tint(np.clip(value, 0, 1), (1, 1, 1)), 0.0003 * strokes * np.clip(
        0.5 + noise(rng, 2, 2), 0, 2
    ) + 0.00015 * grit


def _paint_smooth_plaster(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint a painted wall with faint traces of the roller."""
    value = 0.95 + 0.004 * noise(rng, 90, 90) + 0.006 * noise(rng, 2, 2)
    return tint(np.clip(value, 0, 1), (1, 1, 1)), 0.00012 * noise(rng, 60, 60)


def _paint_tiles(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint four by four stoneware tiles, mottled, in different shades, with pale joints."""
    u, v = grid()
    count = 4
    column, row = (u * count).astype(int), (v * count).astype(int)
    shade = uniform(rng, 0.74, 1.2, (count, count))[row, column]
    clouds = 0.5 * noise(rng, 9, 9) + 0.35 * noise(rng, 26, 26) + 0.15 * noise(rng, 80, 80)
    value = shade * np.clip(1.0 + 0.30 * clouds, 0.2, None)
    color = np.stack([0.150 * value, 0.058 * power(value, 1.15), 0.040 * power(value, 1.2)], -1)
    du = np.abs(u * count - np.round(u * count))
    dv = np.abs(v * count - np.round(v * count))
    joint = np.clip(1.5 - np.minimum(du, dv) / 0.008, 0.0, 1.0)[..., None]
    color = color * (1 - joint) + joint * np.array([0.24, 0.20, 0.18])
    return np.clip(np.nan_to_num(color), 0, 1), 0.0009 * clouds - 0.002 * joint[..., 0]


def _paint_paving(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint the grey setts of a yard, in courses."""
    u, v = grid()
    row = (v * 16).astype(int)
    shifted = (u * 8 + 0.5 * (row % 2)) % 8
    shade = uniform(rng, 0.7, 1.1, (16, 8))[row, shifted.astype(int)]
    du, dv = np.abs(shifted - np.round(shifted)), np.abs(v * 16 - np.round(v * 16))
    joint = (np.minimum(du, dv) < 0.06) * 0.35
    value = 0.55 * shade * (1 + 0.12 * noise(rng, 60, 60)) * (1 - joint)
    return tint(np.clip(value, 0, 1), (1.0, 0.98, 0.94)), flat()


ROOM_PAINTERS: dict[str, Painter] = {
    "carpet": _paint_carpet,
    "plaster": _paint_plaster,
    "smooth_plaster": _paint_smooth_plaster,
    "tiles": _paint_tiles,
    "paving": _paint_paving,
}
