"""Painters of the textures of metals, plastics, stones, fabrics, wicker and fur."""

from __future__ import annotations

import numpy as np

from physion.numerics.elementary import cos, exp, power, sin
from physion.numerics.random_normals import standard_normal
from physion.rendering.textures.noise import (
    F32,
    SIZE,
    Painter,
    cells,
    flat,
    grid,
    noise,
    smooth,
    tint,
    uniform,
)

GREY = (1.0, 1.0, 1.0)


def _paint_plain(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint nothing: white and flat."""
    return np.ones((SIZE, SIZE, 3), np.float32), flat()


def _paint_metal(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint brushed sheet metal."""
    value = 0.86 + 0.03 * noise(rng, 4, 200) + 0.02 * noise(rng, 3, 3)
    return tint(np.clip(value, 0, 1), (1, 1, 1)), flat()


def _paint_cloth(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint a fine weave that is visible only from near."""
    u, v = grid()
    weave = sin(2 * np.pi * 128 * u) * sin(2 * np.pi * 128 * v)
    value = 0.88 + 0.05 * weave + 0.02 * noise(rng, 12, 12)
    return tint(np.clip(value, 0, 1), (1, 1, 1)), flat()


def _paint_brushed(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint metal with the parallel scratches of a wire brush."""
    streaks = 0.7 * noise(rng, 2.5, 120) + 0.5 * noise(rng, 5, 30) + 0.3 * noise(rng, 12, 220)
    return tint(np.clip(0.70 + 0.15 * streaks, 0.1, 1), GREY), flat()


def _paint_cast(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint raw cast iron: dark, with a rough surface and pits."""
    skin = 0.6 * noise(rng, 40, 40) + 0.5 * noise(rng, 110, 110)
    pits = np.clip(noise(rng, 45, 45) - 1.5, 0, 1)
    value = 0.42 + 0.06 * skin - 0.22 * pits + 0.04 * noise(rng, 4, 4)
    return tint(np.clip(value, 0.05, 1), GREY), flat()


def _paint_hammered(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint hammered metal, with dents that are bright on one side and dark on the other."""
    nearest, second, _ = cells(rng, 260)
    edge = nearest / (nearest + second)
    depth = 0.05 * edge**2
    slope = (np.roll(depth, -1, 0) - np.roll(depth, 1, 0)) * (SIZE / 2)
    slope += 0.5 * (np.roll(depth, -1, 1) - np.roll(depth, 1, 1)) * (SIZE / 2)
    value = 0.66 + 0.42 * np.clip(slope, -0.8, 0.8) - 0.12 * smooth(edge, 0.4, 0.5)
    return tint(np.clip(value, 0.05, 1), GREY), flat()


def _paint_matte(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint moulded plastic with a fine grain."""
    return tint(np.clip(0.92 + 0.035 * noise(rng, 130, 130), 0, 1), GREY), flat()


def _paint_speckled(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint recycled plastic: flakes of many colours in a pale ground."""
    nearest, _, cell = cells(rng, 900)
    shade = uniform(rng, 0.12, 1.0, (901, 3)).astype(np.float32) * uniform(rng, 0.3, 1, (901, 1))
    flake = rng.random(901) < 0.42
    size = uniform(rng, 0.006, 0.020, 901).astype(np.float32)
    inside = 1.0 - smooth(nearest / size[cell], 0.85, 1.0)
    weight = (inside * flake[cell])[..., None]
    color = 0.86 * (1.0 - weight) + weight * shade[cell]
    return np.asarray(np.clip(color, 0.02, 1), np.float32), flat()


def _paint_granite(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint crystals of grey quartz, white feldspar and black mica."""
    _, _, cell = cells(rng, 5200)
    kinds = np.array([0.86, 0.52, 0.10], np.float32)
    kind = rng.choice(3, 5201, p=[0.46, 0.34, 0.2])
    shade = (kinds[kind] + 0.05 * standard_normal(rng, 5201)).astype(np.float32)
    value = shade[cell] + 0.03 * noise(rng, 6, 6)
    return tint(np.clip(value, 0.03, 1), (1.0, 0.97, 0.95)), flat()


def _paint_marble(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint white marble with branching grey veins."""
    clouds = noise(rng, 3, 3)
    bent = noise(rng, 2.2, 2.2) + 0.30 * noise(rng, 7, 7) + 0.07 * noise(rng, 24, 24)
    fine = noise(rng, 3.2, 3.2) + 0.35 * noise(rng, 11, 11)
    veins = exp(-np.abs(bent) / 0.10) * np.clip(0.65 + 0.35 * clouds, 0.1, 1)
    hair = exp(-np.abs(fine - 0.3) / 0.035)
    value = 0.94 - 0.52 * veins - 0.22 * hair + 0.025 * clouds
    return tint(np.clip(value, 0.1, 1), (1.0, 0.985, 0.97)), flat()


def _paint_sandstone(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint grains of sand in wavy layers."""
    _, v = grid()
    height = v + 0.012 * noise(rng, 2, 2) + 0.004 * noise(rng, 9, 9)
    layers = sin(2 * np.pi * 7 * height) + 0.7 * sin(2 * np.pi * (17 * height + 0.3))
    value = 0.74 + 0.08 * layers + 0.07 * noise(rng, 170, 170) + 0.03 * noise(rng, 30, 30)
    value = np.clip(value, 0.1, 1.0)
    return np.stack([value, 0.86 * power(value, 1.1), 0.66 * power(value, 1.2)], -1), flat()


def _paint_slate(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint cleft slate: dark sheets in steps, whose broken edges are bright."""
    steps = noise(rng, 3, 7) + 0.30 * noise(rng, 14, 26) + 0.08 * noise(rng, 50, 80)
    sheets = np.floor(1.8 * steps)
    edge = smooth(1.8 * steps - sheets, 0.0, 0.14)
    value = 0.25 + 0.03 * np.clip(sheets, -3, 3) * edge + 0.13 * (1 - edge)
    value += 0.02 * noise(rng, 130, 60)
    return tint(np.clip(value, 0.05, 1), (0.88, 0.96, 1.0)), flat()


def _paint_linen(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint a plain weave of threads of uneven thickness."""
    u, v = grid()
    weft, warp = noise(rng, 4, 44), noise(rng, 44, 4)
    over = sin(2 * np.pi * 56 * u) * sin(2 * np.pi * 56 * v)
    gaps = np.abs(cos(2 * np.pi * 56 * u)) * np.abs(cos(2 * np.pi * 56 * v))
    value = 0.72 + 0.075 * weft + 0.075 * warp + 0.09 * over - 0.10 * gaps
    return tint(np.clip(value, 0.1, 1), (1.0, 0.98, 0.94)), flat()


def _paint_canvas(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint a coarse basket weave: pairs of threads over pairs of threads, as a chequerboard."""
    u, v = grid()
    count = 28
    x, y = (u * count) % 1.0, (v * count) % 1.0
    lying = (np.floor(u * count) + np.floor(v * count)) % 2 == 0
    across = np.where(lying, y, x)
    threads = np.abs(sin(2 * np.pi * across))
    swell = sin(np.pi * np.where(lying, x, y))
    value = (0.28 + 0.5 * threads * (0.45 + 0.55 * swell)) * np.where(lying, 1.08, 0.92)
    value = value + 0.04 * noise(rng, 60, 60) + 0.02 * noise(rng, 6, 6)
    return tint(np.clip(value, 0.05, 1).astype(np.float32), (1.0, 0.98, 0.95)), flat()


def _paint_denim(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint twill: diagonal ridges with white threads between them."""
    u, v = grid()
    ridge = 0.5 + 0.5 * sin(2 * np.pi * (22 * (u + v) + 0.06 * noise(rng, 30, 30)))
    weft = np.clip(0.6 + 0.4 * noise(rng, 150, 25), 0, 1)
    worn = 0.50 + 0.04 * noise(rng, 5, 3)
    value = worn * (0.45 + 0.55 * ridge) + 0.42 * weft * (1 - ridge)
    return tint(np.clip(value + 0.04 * noise(rng, 120, 5), 0.05, 1), GREY), flat()


def _paint_wool(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint stocking stitch: columns of small Vs in fluffy yarn."""
    u, v = grid()
    columns, rows = 18, 26
    x = (u * columns) % 1.0
    side = np.abs(x - 0.5)  # 0 in the middle of a column, 0.5 between two
    along = (v * rows - 1.1 * side) % 1.0
    loop = np.sqrt(((side - 0.26) / 0.25) ** 2 + ((along - 0.5) / 0.52) ** 2)
    yarn = 1.0 - smooth(loop.astype(np.float32), 0.45, 1.1)
    fluff = 0.06 * noise(rng, 150, 150) + 0.03 * noise(rng, 20, 20)
    return tint(np.clip(0.30 + 0.55 * yarn + fluff, 0.03, 1), GREY), flat()


def _paint_wicker(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint flat strips that pass over and under upright canes."""
    u, v = grid()
    canes, strips = 12, 20
    row = (v * strips).astype(int)
    over = cos(2 * np.pi * (u * canes / 2 + 0.5 * (row % 2)))
    across = sin(np.pi * ((v * strips) % 1.0))
    shade = uniform(rng, 0.8, 1.1, (strips, 1))[row[:, 0]]
    value = shade * (0.42 + 0.38 * over) * (0.35 + 0.65 * across) + 0.18
    value = np.clip(value + 0.04 * noise(rng, 8, 120), 0.04, 1.0).astype(np.float32)
    return np.stack([value, 0.88 * power(value, 1.1), 0.72 * power(value, 1.2)], -1), flat()


def _paint_fur(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint short hair that lies along v."""
    hair = 0.6 * noise(rng, 110, 14) + 0.5 * noise(rng, 45, 8)
    value = 0.80 + 0.11 * hair + 0.05 * noise(rng, 5, 5)
    return tint(np.clip(value, 0.1, 1), GREY), flat()


def _paint_moon(rng: np.random.Generator) -> tuple[F32, F32]:
    """Paint grey dust, dark plains, and craters with bright rims."""
    seas = smooth(noise(rng, 2.5, 2.5), 0.1, 0.9)
    nearest, _, cell = cells(rng, 90)
    size = uniform(rng, 0.008, 0.035, 91).astype(np.float32)
    inside = nearest / size[cell]
    rim = exp(-(((inside - 1.0) / 0.18) ** 2))
    pit = 1.0 - smooth(inside, 0.6, 1.0)
    value = 0.78 - 0.38 * seas + 0.16 * rim - 0.14 * pit + 0.03 * noise(rng, 30, 30)
    return tint(np.clip(value, 0.05, 1), GREY), flat()


MATERIAL_PAINTERS: dict[str, Painter] = {
    "plain": _paint_plain,
    "metal": _paint_metal,
    "metal_brushed": _paint_brushed,
    "metal_cast": _paint_cast,
    "metal_hammered": _paint_hammered,
    "plastic_matte": _paint_matte,
    "plastic_speckled": _paint_speckled,
    "stone_granite": _paint_granite,
    "stone_marble": _paint_marble,
    "stone_sandstone": _paint_sandstone,
    "stone_slate": _paint_slate,
    "cloth": _paint_cloth,
    "fabric_canvas": _paint_canvas,
    "fabric_denim": _paint_denim,
    "fabric_linen": _paint_linen,
    "fabric_wool": _paint_wool,
    "moon": _paint_moon,
    "wicker": _paint_wicker,
    "fur": _paint_fur,
}
