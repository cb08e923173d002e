"""A cloth as a sheet of particles: its vertices and triangles, its springs and their correction.

Springs are kept in families: all springs of one family join a particle to the one at the same
offset of indices.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import norm, unit
from physion.numerics.rotations import rotate_vectors
from physion.scenes.scene import Cloth

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]
Indices = NDArray[np.int32]

MIN_LENGTH = 1e-12
"""Metres below which a spring or a slip has no direction."""
EDGES = ((1, 0), (0, 1), (1, 1))
"""Steps along x and y between the ends of the edges of `sheet_triangles`."""
ACROSS = ((1, -1), (1, 2), (2, 1))
"""Steps between the two corners opposite an inner edge: the diagonal, and the sides of squares."""
_CORNERS = (
    (slice(None, -1), slice(None, -1)),
    (slice(1, None), slice(None, -1)),
    (slice(None, -1), slice(1, None)),
    (slice(1, None), slice(1, None)),
)
"""Corners of a square of the sheet, as slices along x and y."""


class SheetSprings(NamedTuple):
    """Distance constraints between particles of a sheet of V particles, in G families.

    Family g joins particle v and particle v + ``offsets[g]``, for all v at once, so that a pass
    over it reads and writes memory in order.

    - ``offsets`` (G,): positive differences of indices.
    - ``lengths`` (G,): metres at rest.
    - ``half_stiffness`` (G, V): half of the fraction of the error that one pass removes; 0 where v
      has no partner in the family.
    - ``degree`` (V,): number of springs at each particle.
    """

    offsets: I64
    lengths: F64
    half_stiffness: F64
    degree: F64


# C = |p_b - p_a| - l. Both ends have one mass, so each gets half of the error, times the stiffness
# k:  dp_a = k/2 C (p_b - p_a) / |p_b - p_a| = -dp_b  (Müller et al. 2007, section 3.3). The loops
# below have no branches and no sums across elements, so that the compiler may take several elements
# at once without changing a bit.


@kernel
def correct_springs(points: F64, springs: SheetSprings, shift: F64, correction: F64) -> None:
    """Fill ``shift`` (3, V) with the sums of the corrections that bring springs to their lengths.

    ``points`` (3, V) are positions in metres, ``correction`` (3, V) is working memory.
    """
    shift[:] = 0.0
    x, y, z = points[0], points[1], points[2]
    number = points.shape[1]
    for g in range(len(springs.offsets)):
        offset = springs.offsets[g]
        first = number - offset
        _corrections(
            (x[:first], y[:first], z[:first]),
            (x[offset:], y[offset:], z[offset:]),
            springs.half_stiffness[g, :first],
            springs.lengths[g],
            (correction[0, :first], correction[1, :first], correction[2, :first]),
        )
        for k in range(3):
            _add(shift[k], correction[k, :first], offset)


@kernel
def _corrections(
    a: tuple[F64, F64, F64],
    b: tuple[F64, F64, F64],
    half: F64,
    length: float,
    out: tuple[F64, F64, F64],
) -> None:
    """Fill ``out`` with k/2 (|b - a| - l) (b - a) / |b - a| of springs from ``a`` to ``b``.

    ``a``, ``b`` and ``out`` are coordinates x, y, z (S,) in metres, ``half`` (S,) is k/2 and
    ``length`` l.
    """
    ax, ay, az = a
    bx, by, bz = b
    cx, cy, cz = out
    for s in range(len(half)):
        dx, dy, dz = bx[s] - ax[s], by[s] - ay[s], bz[s] - az[s]
        found = np.sqrt(dx * dx + dy * dy + dz * dz)
        error = half[s] * (found - length) / found
        error = error if found > MIN_LENGTH else 0.0
        cx[s], cy[s], cz[s] = error * dx, error * dy, error * dz


@kernel
def _add(total: F64, correction: F64, offset: int) -> None:
    """Add ``correction`` (S,) to the first S of ``total`` (V,), and take it from the last S.

    The last begin ``offset`` = V - S places after the first.
    """
    # In the middle both happen, in this order: another one would round otherwise.
    both = max(len(correction) - offset, 0)
    early, late, same = total[offset : offset + both], correction[offset:], correction[:both]
    for s in range(min(offset, len(correction))):
        total[s] += correction[s]
    for s in range(both):
        early[s] = early[s] + late[s] - same[s]
    last = correction[both:]
    end = total[offset + both :]
    for s in range(len(last)):
        end[s] -= last[s]


# Vertices, triangles and springs of an undeformed cloth.


def sheet_vertices(cloth: Cloth) -> F64:
    """Return the vertices (V, 3) of an undeformed cloth in metres, world.

    They come row by row along x, then y: the first ``resolution`` vertices have the lowest x.
    """
    if cloth.resolution < 2:
        raise BadInputError(
            f"cloth {cloth.name!r} needs at least 2 vertices a side, not {cloth.resolution}"
        )
    along_x, along_y = (np.linspace(-s / 2, s / 2, cloth.resolution) for s in cloth.size[:2])
    x, y = np.meshgrid(along_x, along_y, indexing="ij")
    flat = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    return np.asarray(rotate_vectors(unit(cloth.rotation), flat) + np.asarray(cloth.position))


@lru_cache(maxsize=8)
def sheet_triangles(resolution: int) -> Indices:
    """Return the triangles (T, 3) of a sheet: two for each square, along the same diagonal."""
    index = np.arange(resolution**2, dtype=np.int32).reshape(resolution, resolution)
    a, b, c, d = (index[x, y].ravel() for x, y in _CORNERS)
    return np.stack([np.stack([a, b, d], 1), np.stack([a, d, c], 1)], 1).reshape(-1, 3)


def sheet_springs(cloth: Cloth) -> SheetSprings:
    """Return the springs of a cloth, as Flex makes them from its triangles.

    Every edge has the stiffness ``stretch``, the two corners opposite every inner edge ``bend``.
    ``tether`` has no effect: Flex attaches tethers to fixed particles, and there are none.
    """
    rows = cloth.resolution
    steps = np.array(EDGES + (ACROSS if cloth.bend > 0 else ()), np.int64)
    x, y = np.divmod(np.arange(rows**2), rows)
    to_x, to_y = x + steps[:, :1], y + steps[:, 1:]
    joined = (to_x < rows) & (to_y >= 0) & (to_y < rows)
    steps, joined = steps[joined.any(axis=1)], joined[joined.any(axis=1)]
    sides = np.asarray(cloth.size[:2]) / (rows - 1)
    stiffness = np.where(np.arange(len(steps)) < len(EDGES), cloth.stretch, cloth.bend)
    offsets = steps[:, 0] * rows + steps[:, 1]
    degree = np.count_nonzero(joined, axis=0).astype(np.float64)
    for family, offset in zip(joined, offsets, strict=True):
        degree[offset:] += family[: len(degree) - offset]
    return SheetSprings(
        offsets, norm(steps * sides), np.where(joined, stiffness[:, None] / 2, 0.0), degree
    )
