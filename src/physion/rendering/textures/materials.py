"""Painters of procedural textures: metals, plastics, stones, fabrics, fur, woods, floors and walls.

A painter draws a square that repeats without a seam: albedo and height of every texel.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import cos, exp, power, sin, standard_normal, tanh
from physion.numerics.linear_algebra import inverse_real_transform, norm, ordered_mean, outer

F32 = NDArray[np.float32]


# Building blocks of procedural textures: seamless noise, Voronoi cells, coordinates, tints.

SIZE = 512
"""Texels along the side of a texture."""
SPECTRUM_REACH = 2.2
"""Frequency, as a multiple of the scale of the spectrum, up to which noise has a spectrum."""

Painter = Callable[[np.random.Generator], tuple[F32, F32]]
"""Returns linear albedo (SIZE, SIZE, 3) in 0..1 and height (SIZE, SIZE) of a texture; heights are
in units of the texture's side."""


def noise(rng: np.random.Generator, u: float, v: float) -> F32:
    """Draw seamless Gaussian noise (SIZE, SIZE) with mean 0 and standard deviation 1.

    Its spectrum is white noise times exp(-(fu / u)^2 - (fv / v)^2): ``u`` and ``v`` are about the
    numbers of waves over the texture. It is drawn only where this weight is not negligible.
    """
    reach_u, reach_v = (min(int(SPECTRUM_REACH * n) + 1, SIZE // 2 - 1) for n in (u, v))
    fu, fv = np.arange(reach_u + 1), np.arange(-reach_v, reach_v + 1)
    weight = outer(exp(-((fv / v) ** 2)), exp(-((fu / u) ** 2)))
    drawn = standard_normal(rng, (2, *weight.shape))
    spectrum = np.zeros((SIZE, SIZE // 2 + 1), np.complex128)
    spectrum[fv, : reach_u + 1] = weight * (drawn[0] + 1j * drawn[1])
    spectrum[0, 0] = 0.0
    waves = inverse_real_transform(spectrum)
    centered = waves - ordered_mean(waves.reshape(-1))
    deviation = np.sqrt(ordered_mean((centered * centered).reshape(-1)))
    return np.asarray(waves / deviation, np.float32)


def uniform(
    rng: np.random.Generator, low: float, high: float, shape: int | tuple[int, ...]
) -> NDArray[np.float64]:
    """Draw numbers from the uniform distribution between ``low`` and ``high``.

    `numpy.random.Generator.uniform` does the same in C, where a compiler may round the product and
    the sum together; the bits then depend on the processor (numpy issue 22993).
    """
    return low + (high - low) * rng.random(shape)


def grid() -> tuple[F32, F32]:
    """Return the coordinates u and v (SIZE, SIZE) of the centres of texels, 0..1."""
    centers = (np.arange(SIZE, dtype=np.float32) + np.float32(0.5)) / np.float32(SIZE)
    u, v = np.meshgrid(centers, centers)
    return u, v


def tint(value: F32, color: Sequence[float]) -> F32:
    """Return the albedo (SIZE, SIZE, 3) of a linear colour times ``value`` (SIZE, SIZE)."""
    return np.asarray(value[..., None] * np.asarray(color, np.float32), np.float32)


def flat() -> F32:
    """Return the height (SIZE, SIZE) of a flat surface, 0."""
    return np.zeros((SIZE, SIZE), np.float32)


def cells(rng: np.random.Generator, count: int) -> tuple[F32, F32, NDArray[np.int64]]:
    """Draw a seamless Voronoi diagram of ``count`` random points.

    Returns
    -------
    nearest, second, index
        (SIZE, SIZE) each: distances to the nearest and to the second nearest point, in units of
        the texture's side, and the index of the nearest.
    """
    # Imported late: what only reads scenes and trials starts faster.
    from scipy.spatial import KDTree

    u, v = grid()
    points = rng.random((count, 2))
    texels = np.stack([u.ravel(), v.ravel()], 1).astype(np.float64)
    _, which = KDTree(points, boxsize=1.0).query(texels, k=2)
    # The distances that the tree returns may be rounded differently on another processor.
    offset = texels[:, None] - points[which]
    distance = norm(offset - np.round(offset)).astype(np.float32).reshape(SIZE, SIZE, 2)
    return distance[..., 0], distance[..., 1], which[:, 0].reshape(SIZE, SIZE)


def smooth(value: F32, low: float, high: float) -> F32:
    """Return a smooth step: 0 below ``low``, 1 above ``high``, 3 t^2 - 2 t^3 between."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t), np.float32)


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


# Painters of the textures of woods: figure, grain and pores.


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


# Painters of the textures of rooms: carpet, plaster, tiles, paving.


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
