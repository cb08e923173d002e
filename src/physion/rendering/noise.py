"""What textures are painted with: seamless noise, cells, grids."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

F32 = NDArray[np.float32]

SIZE = 512
"""Texels along the side of a texture."""

Painter = Callable[[np.random.Generator], tuple[F32, F32]]
"""Paints (SIZE, SIZE, 3) linear albedo and (SIZE, SIZE) height, in units of the texture's side."""


def noise(rng: np.random.Generator, u: float, v: float) -> F32:
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
    drawn_out = np.fft.irfft2(spectrum, s=(SIZE, SIZE))
    return np.asarray(drawn_out / drawn_out.std(), np.float32)


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
    """A seamless patchwork of ``count`` cells about random points.

    Distances to the nearest and to the second nearest point, in sides of the texture, and which
    is the nearest.
    """
    u, v = grid()
    points = rng.random((count, 2))
    near, which = KDTree(points, boxsize=1.0).query(np.stack([u.ravel(), v.ravel()], 1), k=2)
    first, second = (near[:, i].reshape(SIZE, SIZE).astype(np.float32) for i in (0, 1))
    return first, second, which[:, 0].reshape(SIZE, SIZE)


def smooth(value: F32, low: float, high: float) -> F32:
    """0 below ``low``, 1 above ``high``, a soft step between."""
    t = np.clip((value - low) / (high - low), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t), np.float32)
