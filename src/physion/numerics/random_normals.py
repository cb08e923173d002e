"""Normally distributed random numbers, with the same bytes on every processor.

`numpy.random.Generator.normal` takes its tails from the C library's logarithm and exponential.
Here uniform numbers, which depend on integers alone, are transformed as in Box and Muller (1958):
sqrt(-2 ln u) cos(2 pi v) and sqrt(-2 ln u) sin(2 pi v).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import cos, log, sin


def standard_normal(rng: np.random.Generator, shape: int | tuple[int, ...]) -> NDArray[np.float64]:
    """Draw an array of independent normal numbers with mean 0 and standard deviation 1."""
    size = (shape,) if isinstance(shape, int) else shape
    count = math.prod(size)
    pairs = rng.random((2, (count + 1) // 2))
    radius = np.sqrt(-2.0 * log(1.0 - pairs[0]))  # 1 - u is never 0
    angle = 2.0 * math.pi * pairs[1]
    return np.stack([radius * cos(angle), radius * sin(angle)]).reshape(-1)[:count].reshape(size)
