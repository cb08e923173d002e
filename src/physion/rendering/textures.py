"""Procedural textures with their mip levels, and what each surface finish is made of.

A texture is a square of texels, each with a linear albedo factor (red, green, blue) that the
colour of a body multiplies, and the slope of its relief along u and v. Texels are bytes: the
square root of the albedo, so that dark wood keeps its shades, and slopes around 128.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.errors import UnknownNameError

F32 = NDArray[np.float32]
U8 = NDArray[np.uint8]

SIZE = 512
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


FINISHES = {
    "plain": Finish("plain", gloss=0.05, sharpness=20.0, mirror=0.01),
    "wood_ash": Finish("wood_ash", gloss=0.04, sharpness=24.0, mirror=0.008),
    "wood_cedar": Finish("wood_cedar", gloss=0.06, sharpness=24.0, mirror=0.012),
    "metal": Finish("metal", gloss=0.5, sharpness=40.0, mirror=0.5, metal=1.0),
    "plastic": Finish("plain", gloss=0.30, sharpness=60.0, mirror=0.04),
    "cloth": Finish("cloth", gloss=0.35, sharpness=14.0, mirror=0.03),
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


@lru_cache(maxsize=32)
def _levels(name: str) -> tuple[U8, ...]:
    """Mip levels of one texture, each (side * side, 5) bytes, averaged in linear light."""
    albedo, height = PAINTERS[name](np.random.default_rng(list(name.encode())))
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


Painter = Callable[[np.random.Generator], tuple[F32, F32]]
"""Paints (SIZE, SIZE, 3) linear albedo and (SIZE, SIZE) height, in units of the texture's side."""


def _noise(rng: np.random.Generator, u: float, v: float) -> F32:
    """Seamless noise of mean 0 and deviation 1 with about ``u`` x ``v`` waves over the texture.

    The spectrum is drawn only where the Gaussian that shapes it is not negligible.
    """
    reach_u, reach_v = (min(int(2.2 * waves) + 1, SIZE // 2 - 1) for waves in (u, v))
    fu, fv = np.arange(reach_u + 1), np.arange(-reach_v, reach_v + 1)
    weight = np.outer(np.exp(-((fv / v) ** 2)), np.exp(-((fu / u) ** 2)))
    drawn = rng.standard_normal((2, *weight.shape), np.float32)
    spectrum = np.zeros((SIZE, SIZE // 2 + 1), np.complex64)
    spectrum[fv, : reach_u + 1] = weight * (drawn[0] + 1j * drawn[1])
    spectrum[0, 0] = 0.0
    noise = np.fft.irfft2(spectrum, s=(SIZE, SIZE))
    return np.asarray(noise / noise.std(), np.float32)


def _grid() -> tuple[F32, F32]:
    at = (np.arange(SIZE, dtype=np.float32) + np.float32(0.5)) / np.float32(SIZE)
    u, v = np.meshgrid(at, at)
    return u, v


def _tint(value: F32, color: Sequence[float]) -> F32:
    return np.asarray(value[..., None] * np.asarray(color, np.float32), np.float32)


def _flat() -> F32:
    return np.zeros((SIZE, SIZE), np.float32)


def _plain(rng: np.random.Generator) -> tuple[F32, F32]:
    return np.ones((SIZE, SIZE, 3), np.float32), _flat()


def _ash(rng: np.random.Generator) -> tuple[F32, F32]:
    """Sawn ash: the rings of a trunk cut lengthwise, with a pointed figure in the middle."""
    u, v = _grid()
    warp = 0.026 * _noise(rng, 2.5, 0.8) + 0.003 * _noise(rng, 10, 2)
    depth = 0.10 + 0.16 * np.sin(2 * np.pi * (v + 0.1)) + 0.02 * _noise(rng, 1.5, 2)
    rings = np.sqrt((u - 0.56 + warp) ** 2 + depth**2) * 58.0
    phase = rings - np.floor(rings)
    line = np.exp(-(((phase - 0.75) / 0.20) ** 2))
    pores = np.clip(_noise(rng, 220, 8) - 0.6, 0, None)
    fade = np.clip(0.75 + 0.25 * _noise(rng, 3, 2), 0.2, 1.2)
    streak = np.clip(0.85 + 0.45 * _noise(rng, 200, 14), 0.1, 1.6)
    value = 0.95 - 0.40 * line * fade * streak - 0.07 * pores + 0.02 * _noise(rng, 4, 2)
    return _tint(np.clip(value, 0.05, 1.0), (0.98, 0.90, 0.76)), _flat()


def _cedar(rng: np.random.Generator) -> tuple[F32, F32]:
    """Red cedar glued from narrow staves, each cut from another board."""
    u, v = _grid()
    staves = 5
    index = np.minimum((u * staves).astype(int), staves - 1)
    shade = np.array([0.82, 1.08, 0.70, 0.95, 1.15])[index]
    warp = 0.10 * _noise(rng, 6, 1.2) + 0.7 * index
    phase = (u * 26 + warp * 6 + 0.8 * np.sin(2 * np.pi * (v * 0.5 + 0.31 * index))) % 1.0
    grain = np.exp(-(((phase - 0.5) / 0.22) ** 2))
    fibre = _noise(rng, 160, 5)
    joint = np.abs(u * staves - np.round(u * staves)) < 0.018
    value = shade * (0.92 - 0.30 * grain + 0.05 * fibre) * np.where(joint, 0.55, 1.0)
    red = np.clip(value, 0.04, 1.4)
    color = np.stack([0.46 * red, 0.27 * red**1.15, 0.20 * red**1.2], -1)
    return np.clip(color, 0, 1), _flat()


def _carpet(rng: np.random.Generator) -> tuple[F32, F32]:
    """Loops of wool in rows, some of them paler."""
    u, v = _grid()
    rows = np.sin(2 * np.pi * 70 * v) * np.sin(2 * np.pi * (70 * u + 0.5 * np.floor(70 * v)))
    fleck = _noise(rng, 110, 90)
    height = 0.3 * rows + 0.8 * fleck + 0.4 * _noise(rng, 45, 36)
    value = 0.52 * np.exp(0.48 * height + 0.03 * _noise(rng, 4, 4))
    return np.clip(_tint(value, (1.0, 1.0, 1.0)), 0.02, 1), 0.0002 * height


def _plaster(rng: np.random.Generator) -> tuple[F32, F32]:
    """Trowelled plaster: broad strokes and grit."""
    strokes = _noise(rng, 8, 26) + 0.6 * _noise(rng, 34, 16)
    grit = _noise(rng, 120, 120)
    value = 0.90 + 0.012 * strokes + 0.008 * grit + 0.015 * _noise(rng, 2, 2)
    return _tint(np.clip(value, 0, 1), (1, 1, 1)), 0.0003 * strokes * np.clip(
        0.5 + _noise(rng, 2, 2), 0, 2
    ) + 0.00015 * grit


def _smooth_plaster(rng: np.random.Generator) -> tuple[F32, F32]:
    """Painted wall with hardly a trace of the roller."""
    value = 0.95 + 0.004 * _noise(rng, 90, 90) + 0.006 * _noise(rng, 2, 2)
    return _tint(np.clip(value, 0, 1), (1, 1, 1)), 0.00012 * _noise(rng, 60, 60)


def _tiles(rng: np.random.Generator) -> tuple[F32, F32]:
    """Four by four stoneware tiles, each mottled and of its own shade, with pale joints."""
    u, v = _grid()
    count = 4
    column, row = (u * count).astype(int), (v * count).astype(int)
    shade = rng.uniform(0.74, 1.2, (count, count))[row, column]
    clouds = 0.5 * _noise(rng, 9, 9) + 0.35 * _noise(rng, 26, 26) + 0.15 * _noise(rng, 80, 80)
    value = shade * np.clip(1.0 + 0.30 * clouds, 0.2, None)
    color = np.stack([0.150 * value, 0.058 * value**1.15, 0.040 * value**1.2], -1)
    du = np.abs(u * count - np.round(u * count))
    dv = np.abs(v * count - np.round(v * count))
    joint = np.clip(1.5 - np.minimum(du, dv) / 0.008, 0.0, 1.0)[..., None]
    color = color * (1 - joint) + joint * np.array([0.24, 0.20, 0.18])
    return np.clip(np.nan_to_num(color), 0, 1), 0.0009 * clouds - 0.002 * joint[..., 0]


def _paving(rng: np.random.Generator) -> tuple[F32, F32]:
    """Grey setts of a yard, in courses."""
    u, v = _grid()
    row = (v * 16).astype(int)
    shifted = (u * 8 + 0.5 * (row % 2)) % 8
    shade = rng.uniform(0.7, 1.1, (16, 8))[row, shifted.astype(int)]
    du, dv = np.abs(shifted - np.round(shifted)), np.abs(v * 16 - np.round(v * 16))
    joint = (np.minimum(du, dv) < 0.06) * 0.35
    value = 0.55 * shade * (1 + 0.12 * _noise(rng, 60, 60)) * (1 - joint)
    return _tint(np.clip(value, 0, 1), (1.0, 0.98, 0.94)), _flat()


def _metal(rng: np.random.Generator) -> tuple[F32, F32]:
    """Brushed sheet."""
    value = 0.86 + 0.03 * _noise(rng, 4, 200) + 0.02 * _noise(rng, 3, 3)
    return _tint(np.clip(value, 0, 1), (1, 1, 1)), _flat()


def _cloth(rng: np.random.Generator) -> tuple[F32, F32]:
    """Fine weave, visible from near only."""
    u, v = _grid()
    weave = np.sin(2 * np.pi * 128 * u) * np.sin(2 * np.pi * 128 * v)
    value = 0.88 + 0.05 * weave + 0.02 * _noise(rng, 12, 12)
    return _tint(np.clip(value, 0, 1), (1, 1, 1)), _flat()


PAINTERS: dict[str, Painter] = {
    "plain": _plain,
    "wood_ash": _ash,
    "wood_cedar": _cedar,
    "carpet": _carpet,
    "plaster": _plaster,
    "smooth_plaster": _smooth_plaster,
    "tiles": _tiles,
    "paving": _paving,
    "metal": _metal,
    "cloth": _cloth,
}
