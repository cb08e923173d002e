"""Sample bodies as particles, the input of particle-based models.

Particles fill the drawn solid, so that bowls, tori, pipes and vases keep their hollows and thin
walls stay closed. `physion.physics.cloth.solids` fills the collision pieces instead, as NVIDIA Flex
does.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.core.seeds import child_generator, named_seed
from physion.numerics.linear_algebra import norm
from physion.numerics.rotations import rotate_vectors
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import Scene, Vec3
from physion.scenes.shapes.meshes import Mesh
from physion.scenes.shapes.primitives import shape

SPACING, CLOTH_SPACING = 0.05, 0.035
"""Metres between particles, and in scenes with cloth (docs/official-system.md, section 6)."""
LIMIT = 3000
"""Largest number of particles of one object (docs/official-system.md, section 6)."""
FINE = 4
"""Cells a side into which the cube of each particle is divided, to measure how full it is."""
REACH = 1.12
"""Largest distance, in spacings, from a solid cell to the nearest particle. What extends beyond a
full cube by less than half a cube is closer than that."""
MAX_LATTICE = 2**21
"""Largest number of lattice points of one object, filled or not: its cells must fit in memory."""

Floats = NDArray[np.float32]
Filled = NDArray[np.bool_]


@dataclass(frozen=True)
class Particles:
    """Particles of a scene over time. T frames, P particles.

    - ``positions`` (T, P, 3): metres, world.
    - ``things`` (P,): index in `Scene.names` of the object of each particle, in blocks.
    - ``frames`` (T,): frame of the trial of each row.
    """

    positions: Floats
    things: NDArray[np.int32]
    frames: NDArray[np.int64]


def default_spacing(scene: Scene) -> float:
    """Return the particle spacing in metres that the original study used for such a scene."""
    return CLOTH_SPACING if scene.cloths else SPACING


def sample_particles(
    shape_name: str, scale: Vec3, spacing: float = SPACING, limit: int | None = LIMIT
) -> Floats:
    """Return particles (P, 3) that fill a shape: metres in the body's frame, pose not applied.

    The same arguments give the same particles.

    Parameters
    ----------
    shape_name, scale
        Shape and its factors along x, y, z.
    spacing : float
        Metres between particles.
    limit : int or None
        Largest number of particles; a body with more keeps that many, drawn without replacement.
        None keeps all.

    Raises
    ------
    UnknownNameError
        If there is no such shape.
    BadInputError
        If the spacing is not above 0, or too small for the body.

    Notes
    -----
    Particles lie on a cubic lattice that is centred in the bounds. A lattice point is filled where
    at least half of its cube is solid, so that volume is kept where bodies are thick. Where a solid
    cell would still be farther than `REACH` from every particle, the fullest cubes are filled too,
    so that thin walls stay closed.
    """
    if not spacing > 0:
        raise BadInputError(f"particle spacing {spacing} is not above 0 metres")
    points = _fill(shape_name, tuple(scale), float(spacing))
    if limit is not None and len(points) > limit:
        # A thinned lattice would keep planes of the body and lose others.
        seed = named_seed(shape_name, repr(scale), repr(spacing), limit)
        kept = child_generator(seed, "particles").choice(len(points), limit, replace=False)
        points = points[np.sort(kept)]
    return points.copy()


def particles_over_time(
    scene: Scene,
    trajectory: Trajectory,
    frames: Sequence[int] | None = None,
) -> Particles:
    """Return the particles of all bodies at their poses, followed by the vertices of all cloths.

    They are as far apart as in the original study (`default_spacing`). Scenery is left out, as it
    does not collide. ``frames``: those to return, by default all; `BadInputError` for frames
    outside the trajectory.
    """
    wanted = np.arange(len(trajectory)) if frames is None else np.asarray(frames, np.int64)
    if wanted.size and not (wanted.min() >= 0 and wanted.max() < len(trajectory)):
        raise BadInputError(f"frames {wanted.tolist()} are not within 0..{len(trajectory) - 1}")
    spacing = default_spacing(scene)
    clouds, things = [], []
    for index, body in enumerate(scene.bodies):
        if body.scenery:
            continue
        points = sample_particles(body.shape, body.scale, spacing).astype(np.float64)
        rotations = trajectory.rotations[wanted, index].astype(np.float64)
        rotated = rotate_vectors(rotations[:, None], points[None])
        clouds.append(rotated + trajectory.positions[wanted, index, None])
        things.append(np.full(len(points), index, np.int32))
    clouds.append(trajectory.cloth_vertices[wanted].astype(np.float64))
    things += [
        np.full(cloth.resolution**2, len(scene.bodies) + index, np.int32)
        for index, cloth in enumerate(scene.cloths)
    ]
    positions = np.concatenate(clouds, axis=1).astype(np.float32)
    return Particles(positions, np.concatenate(things or [np.zeros(0, np.int32)]), wanted)


@lru_cache(maxsize=256)
def _fill(shape_name: str, scale: Vec3, spacing: float) -> Floats:
    """Return all particles (P, 3) of a shape, without limit."""
    mesh = shape(shape_name).mesh.moved(scale)
    low, high = mesh.bounds
    # Rounded, so that on average the cubes fill the bounds; points stay inside them.
    counts = np.maximum(np.rint((high - low) / spacing), 1)
    if math.prod(counts) > MAX_LATTICE:
        raise BadInputError(
            f"{shape_name!r} of {np.round(high - low, 3).tolist()} m needs {math.prod(counts):.0f} "
            f"lattice points at a spacing of {spacing} m; at most {MAX_LATTICE}: use a larger one"
        )
    sizes = counts.astype(int)
    corner = (low + high) / 2 - sizes * spacing / 2
    grid = (mesh, corner, (int(sizes[0]) * FINE, int(sizes[1]) * FINE, int(sizes[2]) * FINE))
    solid = _by_cube(inside_cells(*grid, spacing / FINE))
    filled = _close_thin(solid, solid | _by_cube(_surface_cells(*grid, spacing / FINE)))
    if not filled.any():
        filled[tuple(sizes // 2)] = True
    return np.asarray(corner + spacing * (np.argwhere(filled) + 0.5), np.float32)


def _by_cube(fine: Filled) -> Filled:
    """Return the cells of a grid grouped by the cube of each particle, (I, J, K, cells)."""
    i, j, k = (count // FINE for count in fine.shape)
    return fine.reshape(i, FINE, j, FINE, k, FINE).transpose(0, 2, 4, 1, 3, 5).reshape(i, j, k, -1)


def _close_thin(solid: Filled, matter: Filled) -> Filled:
    """Return which cubes (I, J, K) to fill, from their cells (I, J, K, cells).

    ``solid`` cells have their centre inside; ``matter`` also includes those that a surface crosses,
    because walls thinner than a cell may miss all centres.
    """
    solid_fraction = np.count_nonzero(solid, axis=-1) / solid.shape[-1]
    filled = np.pad(solid_fraction >= 0.5, 1)
    offsets = (np.indices((FINE,) * 3).reshape(3, -1).T + 0.5) / FINE - 0.5
    near = np.indices((3, 3, 3)).reshape(3, -1).T - 1
    covers = norm(offsets[:, None] - near) <= REACH
    thin = np.argwhere(matter.any(axis=-1) & (solid_fraction < 0.5))
    matter_fraction = np.count_nonzero(matter, axis=-1) / matter.shape[-1]
    fullness = (solid_fraction + matter_fraction)[tuple(thin.T)]
    for i, j, k in thin[np.argsort(-fullness, kind="stable")]:
        neighbours = filled[i : i + 3, j : j + 3, k : k + 3].ravel()
        if not covers[matter[i, j, k]][:, neighbours].any(axis=1).all():
            filled[i + 1, j + 1, k + 1] = True
    return np.asarray(filled[1:-1, 1:-1, 1:-1])


def _surface_cells(
    mesh: Mesh, corner: NDArray[np.float64], counts: tuple[int, int, int], size: float
) -> Filled:
    """Return the cells of a grid (see `inside_cells`) that the surface passes through."""
    cells = np.zeros(counts, np.bool_)
    points = (mesh.vertices - corner) / size
    for a, b, c in points[mesh.faces]:
        longest = max(norm(b - a), norm(c - a), norm(c - b))
        steps = int(np.ceil(longest)) + 1
        u, v = (np.indices((steps + 1, steps + 1)) / steps).reshape(2, -1, 1)
        on = (a + u * (b - a) + v * (c - a))[u[:, 0] + v[:, 0] <= 1 + 1e-9]
        cells[tuple(np.clip(on.astype(int), 0, np.array(counts) - 1).T)] = True
    return cells


def inside_cells(
    mesh: Mesh, corner: NDArray[np.float64], counts: tuple[int, int, int], size: float
) -> Filled:
    """Return which cells of a grid have their centre inside a closed mesh.

    Parts of the mesh may overlap.

    Parameters
    ----------
    mesh : Mesh
        Closed, with outward faces.
    corner : (3,)
        Lowest corner of the grid, metres.
    counts : (int, int, int)
        Cells along x, y, z.
    size : float
        Metres a side of a cell.

    Notes
    -----
    A centre is inside where the faces above it that face up outnumber those that face down, that
    is where its winding number is above 0.
    """
    nx, ny, nz = counts
    changes = np.zeros((nx, ny, nz + 1), np.int32)
    # In units of cells; the shift keeps columns off the corners and edges of regular shapes.
    points = (mesh.vertices - corner) / size - 0.5 + np.array([1.1e-6, 1.7e-6, 0.0])
    for face in mesh.faces:
        a, b, c = points[face]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        low = np.maximum(np.ceil(np.minimum(np.minimum(a, b), c)[:2]), 0).astype(int)
        high = np.minimum(np.floor(np.maximum(np.maximum(a, b), c)[:2]), (nx - 1, ny - 1))
        if area == 0 or (high < low).any():
            continue
        x = np.arange(low[0], int(high[0]) + 1)[:, None]
        y = np.arange(low[1], int(high[1]) + 1)[None, :]
        sides = (face[[1, 2]], face[[2, 0]], face[[0, 1]])
        weights = [_edge(points, p, q, x, y) for p, q in sides]
        # An edge belongs to one of its two faces, whichever way each of them runs along it.
        hit = np.ones((x.size, y.size), np.bool_)
        for value, (p, q) in zip(weights, sides, strict=True):
            left = value >= 0 if p < q else value > 0
            hit &= left if area > 0 else ~left
        at_x, at_y = np.nonzero(hit)
        first, second, third = (weight[hit] for weight in weights)
        height = (first * a[2] + second * b[2] + third * c[2]) / area
        below = np.clip(np.ceil(height), 0, nz).astype(int)
        np.add.at(changes, (at_x + low[0], at_y + low[1], below), 1 if area > 0 else -1)
    # A face counts for all cells below it: `below` of them.
    above = changes[:, :, ::-1].cumsum(axis=2)[:, :, ::-1]
    return np.asarray(above[:, :, 1:] > 0)


def _edge(
    points: NDArray[np.float64],
    p: np.int32,
    q: np.int32,
    x: NDArray[np.int64],
    y: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Return the signed distance of columns from the edge p-q, times its length; left is positive.

    It is computed in one order of the corners, so that both faces of an edge get the same number.
    """
    first, last, sign = (p, q, 1.0) if p < q else (q, p, -1.0)
    (ax, ay, _), (bx, by, _) = points[first], points[last]
    return np.asarray(sign * ((bx - ax) * (y - ay) - (by - ay) * (x - ax)))
