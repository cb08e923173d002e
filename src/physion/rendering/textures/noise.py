"""What textures are painted with: seamless noise, cells, grids."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from physion.numerics.elementary import exp
from physion.numerics.fourier import inverse_real_transform
from physion.numerics.linear_algebra import norm, ordered_mean, outer
from physion.numerics.random_normals import standard_normal

F32 = NDArray[np.float32]

SIZE = 512
"""Texels along the side of a texture."""

Painter = Callable[[np.random.Generator], tuple[F32, F32]]
"""Paints (SIZE, SIZE, 3) linear albedo and (SIZE, SIZE) height, in units of the texture's side."""


def noise(rng: np.random.Generator, u: float, v: float) -> F32:
    """Draw seamless noise of mean 0 and deviation 1, about ``u`` x ``v`` waves over the texture.

    The spectrum is drawn only where the Gaussian that shapes it is not negligible.
    """
    reach_u, reach_v = (min(int(2.2 * waves) + 1, SIZE // 2 - 1) for waves in (u, v))
    fu, fv = np.arange(reach_u + 1), np.arange(-reach_v, reach_v + 1)
    weight = outer(exp(-((fv / v) ** 2)), exp(-((fu / u) ** 2)))
    drawn = standard_normal(rng, (2, *weight.shape))
    spectrum = np.zeros((SIZE, SIZE // 2 + 1), np.complex128)
    spectrum[fv, : reach_u + 1] = weight * (drawn[0] + 1j * drawn[1])
    spectrum[0, 0] = 0.0
    waves = inverse_real_transform(spectrum)
    away = waves - ordered_mean(waves.reshape(-1))
    deviation = np.sqrt(ordered_mean((away * away).reshape(-1)))
    return np.asarray(waves / deviation, np.float32)


def uniform(
    rng: np.random.Generator, low: float, high: float, shape: int | tuple[int, ...]
) -> NDArray[np.float64]:
    """Draw numbers between ``low`` and ``high``.

    `numpy.random.Generator.uniform` does the same in C, where a compiler may round the product and
    the sum together; the bits then depend on the processor (numpy issue 22993).
    """
    return low + (high - low) * rng.random(shape)


def grid() -> tuple[F32, F32]:
    """Coordinates u and v (SIZE, SIZE) of the middles of texels, 0..1."""
    at = (np.arange(SIZE, dtype=np.float32) + np.float32(0.5)) / np.float32(SIZE)
    u, v = np.meshgrid(at, at)
    return u, v


def tint(value: F32, color: Sequence[float]) -> F32:
    """Albedo (SIZE, SIZE, 3): a colour in each of these shades."""
    return np.asarray(value[..., None] * np.asarray(color, np.float32), np.float32)


def flat() -> F32:
    """No relief."""
    return np.zeros((SIZE, SIZE), np.float32)


def cells(rng: np.random.Generator, count: int) -> tuple[F32, F32, NDArray[np.int64]]:
    """Draw a seamless patchwork of ``count`` cells about random points.

    Return distances to the nearest and to the second nearest point, in sides of the texture, and
    which is the nearest.
    """
    u, v = grid()
    points = rng.random((count, 2))
    texels = np.stack([u.ravel(), v.ravel()], 1).astype(np.float64)
    _, which = KDTree(points, boxsize=1.0).query(texels, k=2)
    # The tree's own distances may be rounded differently on another processor.
    away = texels[:, None] - points[which]
    near = norm(away - np.round(away)).astype(np.float32).reshape(SIZE, SIZE, 2)
    return near[..., 0], near[..., 1], which[:, 0].reshape(SIZE, SIZE)


def smooth(value: F32, low: float, high: float) -> F32:
    """0 below ``low``, 1 above ``high``, a soft step between."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t), np.float32)
