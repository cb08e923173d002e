"""Fill rigid bodies with cubic lattices of particles, as NVIDIA Flex does."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import dot, multiply, norm
from physion.physics.cloth.near_solids import Solids
from physion.scenes.scene import Body, Vec3
from physion.scenes.shapes.primitives import ConvexPiece, shape

Points = NDArray[np.float64]
Filled = NDArray[np.bool_]


@lru_cache(maxsize=256)
def fill_shape(name: str, scale: Vec3, spacing: float) -> tuple[Points, Filled]:
    """Fill a shape at ``scale`` with a lattice of particles ``spacing`` metres apart.

    The lattice is centred in the bounds and holds as many whole spacings as fit, at least one point
    a side. A shape that contains no lattice point gets the one closest to its middle, so that no
    body is without particles.

    Returns
    -------
    origin : (3,)
        First corner of the lattice in the body's frame, metres.
    filled : (I, J, K)
        Lattice points inside a collision piece.
    """
    found = shape(name)
    low, high = found.bounds * np.asarray(scale)
    # A side of exactly n spacings holds n points however its length was rounded.
    sizes = np.maximum(((high - low) / spacing * (1 + 1e-4)).astype(int), 1)
    origin = (low + high) / 2 - (sizes - 1) / 2 * spacing
    axes = [origin[k] + spacing * np.arange(sizes[k]) for k in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    filled = np.zeros(len(grid), np.bool_)
    for number, piece in enumerate(found.pieces):
        if piece.kind == "convex":
            _fill_convex(grid / np.asarray(scale), _planes(name, number), filled)
        else:
            filled |= _inside(piece, grid / np.asarray(scale))
    if not filled.any():
        filled[np.argmin(norm(grid - (low + high) / 2))] = True
    return origin, filled.reshape(tuple(int(n) for n in sizes))


@lru_cache(maxsize=1024)
def _planes(name: str, number: int) -> Points:
    """Return the faces (K, 4) of a convex piece of a shape: unit normal out, and offset."""
    # Imported late: what only reads scenes and trials starts faster.
    from scipy.spatial import ConvexHull

    return np.ascontiguousarray(ConvexHull(shape(name).pieces[number].vertices).equations)


@kernel
def _fill_convex(points: Points, planes: Points, filled: Filled) -> None:
    """Set ``filled`` (P,) for the ``points`` (P, 3) that lie on the inner side of all planes."""
    for p in range(len(points)):
        inside = not filled[p]
        for k in range(len(planes)):
            if not inside:
                break
            height = points[p, 0] * planes[k, 0] + points[p, 1] * planes[k, 1]
            inside = height + points[p, 2] * planes[k, 2] + planes[k, 3] <= 1e-9
        if inside:
            filled[p] = True


def _inside(piece: ConvexPiece, points: Points) -> Filled:
    """Return which ``points`` (P, 3), in the shape's frame at unit scale, lie in a piece.

    The piece is a box, a sphere or a cylinder.
    """
    local = multiply(points - np.asarray(piece.center), piece.rotation) / np.asarray(piece.half)
    if piece.kind == "box":
        return np.asarray((np.abs(local) <= 1 + 1e-9).all(axis=1))
    if piece.kind == "sphere":
        return np.asarray(dot(local, local) <= 1 + 1e-9)
    in_circle = dot(local[:, :2], local[:, :2]) <= 1 + 1e-9
    return np.asarray(in_circle & (np.abs(local[:, 2]) <= 1 + 1e-9))


def particles_of(body: Body, spacing: float) -> Points:
    """Return the particles (P, 3) of a body in its own frame, metres; its pose is not applied."""
    origin, filled = fill_shape(body.shape, body.scale, spacing)
    return np.asarray(origin + spacing * np.argwhere(filled))


def surface_particles(body: Body, spacing: float) -> Points:
    """Return the particles (P, 3) of a body that lack one of their six neighbours.

    They are enough to find the smallest distance to something outside.
    """
    origin, filled = fill_shape(body.shape, body.scale, spacing)
    padded = np.pad(filled, 1)
    buried = filled.copy()
    for axis in range(3):
        for shift in (-1, 1):
            buried &= np.roll(padded, shift, axis)[1:-1, 1:-1, 1:-1]
    return np.asarray(origin + spacing * np.argwhere(filled & ~buried))


def fill_bodies(bodies: tuple[Body, ...], spacing: float) -> Solids:
    """Return the lattices of all bodies, in their order; those of scenery are empty."""
    return fill_lattices(
        [None if body.scenery else (body.shape, body.scale) for body in bodies], spacing
    )


def fill_lattices(shapes: Sequence[tuple[str, Vec3] | None], spacing: float) -> Solids:
    """Return the lattices of shapes at their scales; None stands for an empty one."""
    lattices = [
        (np.zeros(3), np.zeros((0, 0, 0), np.bool_))
        if found is None
        else fill_shape(found[0], found[1], spacing)
        for found in shapes
    ]
    counts = np.array([filled.size for _, filled in lattices], np.int64)
    return Solids(
        np.array([origin for origin, _ in lattices], np.float64).reshape(-1, 3),
        np.array([filled.shape for _, filled in lattices], np.int64).reshape(-1, 3),
        np.concatenate([np.zeros(1, np.int64), np.cumsum(counts)[:-1]])
        if len(counts)
        else np.zeros(0, np.int64),
        np.concatenate([filled.ravel() for _, filled in lattices] or [np.zeros(0, np.bool_)]),
        spacing,
    )
