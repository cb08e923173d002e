"""Building blocks of procedural textures: seamless noise, Voronoi cells, coordinates, tints."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import exp
from physion.numerics.fourier import inverse_real_transform
from physion.numerics.linear_algebra import norm, ordered_mean, outer
from physion.numerics.random_normals import standard_normal

F32 = NDArray[np.float32]

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
