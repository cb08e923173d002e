"""The convex pieces that a body collides with, as corner points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def collision_hulls(shape: str, scale: tuple[float, float, float]) -> list[Array]:
    """STUB until scenes/shapes.py is here."""
    s = np.asarray(scale)
    if shape == "cylinder":
        a = np.linspace(0, 2 * np.pi, 32, endpoint=False)
        c = np.c_[0.5 * np.cos(a), 0.5 * np.sin(a), 0 * a]
        return [np.concatenate([c, c + [0, 0, 1]]) * s]
    if shape == "sphere":
        u = np.linspace(0, np.pi, 13)[1:-1]
        a = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        p = [
            [0.5 * np.sin(t) * np.cos(f), 0.5 * np.sin(t) * np.sin(f), 0.5 + 0.5 * np.cos(t)]
            for t in u
            for f in a
        ]
        return [np.array([*p, [0, 0, 0], [0, 0, 1]]) * s]
    x = np.array([[i, j, k] for i in (-0.5, 0.5) for j in (-0.5, 0.5) for k in (0, 1)], float)
    return [x * s]
