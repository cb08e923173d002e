"""Solid particles near points: records of bodies filled with particles, their poses, the search."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel
from physion.numerics.rotations import rotation_matrix

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

MAX_NEIGHBOURS = 100
"""Most solid particles in contact with one cloth particle (limit of the official container);
further ones are ignored."""
ROUNDING = 1e-9
"""Metres added to the box of a search, so that rounding excludes no particle."""


class Solids(NamedTuple):
    """Particles that fill N rigid bodies, each body's on a cubic lattice in its own frame.

    ``origins`` (N, 3) metres of the lattices' first corners, ``sizes`` (N, 3) points a side,
    ``starts`` (N,) where a body's occupancy begins in ``filled`` (row-major), ``spacing`` metres.
    """

    origins: F64
    sizes: I64
    starts: I64
    filled: NDArray[np.bool_]
    spacing: float


class BodyPoses(NamedTuple):
    """Poses of N bodies: positions ``x`` (N, 3) in metres, rotation matrices ``rot`` (N, 3, 3)."""

    x: F64
    rot: F64


class Neighbours(NamedTuple):
    """Solid particles near each of V cloth particles, K at most.

    ``counts`` (V,) how many; ``body`` (V, K) the body of each; ``position`` (V, K, 3) metres,
    world; ``displacement`` (V, K, 3) metres that it moved during the substep; ``searched_at``
    (3, V) where the particle was when they were searched, metres.
    """

    counts: I64
    body: I64
    position: F64
    displacement: F64
    searched_at: F64


@kernel
def new_poses(bodies: int) -> BodyPoses:
    """Return room for the poses of ``bodies`` bodies."""
    return BodyPoses(np.zeros((bodies, 3)), np.zeros((bodies, 3, 3)))


@kernel
def new_neighbours(particles: int, room: int) -> Neighbours:
    """Return room for ``room`` neighbours of each of ``particles`` particles."""
    return Neighbours(
        np.zeros(particles, np.int64),
        np.empty((particles, room), np.int64),
        np.empty((particles, room, 3)),
        np.empty((particles, room, 3)),
        np.full((3, particles), np.inf),
    )


# Poses between frames: positions are interpolated linearly, orientations by the normalized linear
# mix of quaternions, q = ((1 - f) q0 +- f q1) / |...|, on the shorter way round (q and -q are one
# rotation).


@kernel
def interpolate_poses(
    positions: F64, rotations: F64, frame: int, fraction: float, out: BodyPoses
) -> None:
    """Fill ``out`` with the poses a ``fraction`` of the way from frame ``frame`` - 1 to ``frame``.

    ``positions`` (F, N, 3) are in metres, ``rotations`` (F, N, 4) quaternions (w, x, y, z).
    """
    mixed = np.empty(4)
    for body in range(positions.shape[1]):
        old, new = rotations[frame - 1, body], rotations[frame, body]
        dot = old[0] * new[0] + old[1] * new[1] + old[2] * new[2] + old[3] * new[3]
        sign = 1.0 if dot >= 0 else -1.0
        for k in range(4):
            mixed[k] = (1 - fraction) * old[k] + fraction * sign * new[k]
        length = np.sqrt(mixed[0] ** 2 + mixed[1] ** 2 + mixed[2] ** 2 + mixed[3] ** 2)
        for k in range(4):
            mixed[k] /= length
        out.rot[body] = rotation_matrix(mixed)
        for k in range(3):
            out.x[body, k] = (1 - fraction) * positions[frame - 1, body, k]
            out.x[body, k] += fraction * positions[frame, body, k]


@kernel
def to_local(point: F64, x: F64, rot: F64, out: F64) -> None:
    """Fill ``out`` (3,) with R^T (point - x): a world point (3,) in the frame of a body.

    ``x`` (3,) metres and ``rot`` (3, 3) are the body's pose.
    """
    for k in range(3):
        out[k] = 0.0
        for j in range(3):
            out[k] += rot[j, k] * (point[j] - x[j])


@kernel
def world_bounds(solids: Solids, poses: BodyPoses, reach: float, low: F64, high: F64) -> None:
    """Fill ``low`` and ``high`` (N, 3) with boxes that hold all points within ``reach`` metres.

    A body without particles gets an empty box.
    """
    for body in range(len(solids.origins)):
        for k in range(3):
            low[body, k], high[body, k] = np.inf, -np.inf
        if min(solids.sizes[body, 0], solids.sizes[body, 1], solids.sizes[body, 2]) < 1:
            continue
        for k in range(3):
            middle, half = poses.x[body, k], reach
            for m in range(3):
                side = 0.5 * (solids.sizes[body, m] - 1) * solids.spacing
                middle += poses.rot[body, k, m] * (solids.origins[body, m] + side)
                half += abs(poses.rot[body, k, m]) * side
            low[body, k], high[body, k] = middle - half, middle + half


# Contact search: a cloth particle inside the box of a body is taken into that body's frame, where
# the lattice cells within ``reach`` are a small box of indices. Macklin et al. 2014 search once a
# substep at the predicted positions, with a hash grid. Here what was found is kept while the
# particle is within half of the margin of where it was searched and no body moves.


@kernel
def find_neighbours(
    points: F64,
    reach: float,
    keep: float,
    solids: Solids,
    poses: BodyPoses,
    old: BodyPoses,
    bounds: tuple[F64, F64],
    near: Neighbours,
) -> None:
    """Fill ``near`` with the solid particles within ``reach`` of every cloth particle.

    Parameters
    ----------
    points : (3, V)
        Cloth particles, metres, world.
    reach : float
        Metres.
    keep : float
        Metres that a particle may have moved since its last search; below 0 all are searched.
    solids, poses, old
        Solid particles; poses of the bodies at the end and at the start of the substep.
    bounds : (N, 3), (N, 3)
        Of `world_bounds`.
    near : Neighbours
        Is filled; at most `MAX_NEIGHBOURS` a particle, in the order of bodies.
    """
    # Records are taken apart here, and nothing is called or allocated below: either would cost more
    # than the search.
    box_low, box_high = bounds
    origins, sizes, starts, filled, spacing = solids
    x, rot = poses
    old_x, old_rot = old
    counts, of_body, position, displacement, searched_at = near
    point, local, outside = np.empty(3), np.empty(3), np.empty(3)
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    square = reach * reach
    for v in range(points.shape[1]):
        moved = 0.0
        for k in range(3):
            point[k] = points[k, v]
            moved += (point[k] - searched_at[k, v]) ** 2
        if keep >= 0 and moved <= keep * keep:
            continue
        for k in range(3):
            searched_at[k, v] = point[k]
        found = 0
        for body in range(len(origins)):
            apart = False
            for k in range(3):
                apart = apart or point[k] < box_low[body, k] or point[k] > box_high[body, k]
            if apart:
                continue
            total = 0.0
            for k in range(3):
                local[k] = -origins[body, k]
                for m in range(3):
                    local[k] += rot[body, m, k] * (point[m] - x[body, m])
                end = (sizes[body, k] - 1) * spacing
                outside[k] = max(-local[k], 0.0, local[k] - end) ** 2
                total += outside[k]
            if total >= square:
                continue
            for k in range(3):
                # What the point is outside the lattice along the other axes leaves less along this.
                left = np.sqrt(square - (total - outside[k])) + ROUNDING
                low[k] = max(int(np.ceil((local[k] - left) / spacing)), 0)
                high[k] = min(int(np.floor((local[k] + left) / spacing)), sizes[body, k] - 1)
            for i in range(low[0], high[0] + 1):
                dx = local[0] - i * spacing
                sx = origins[body, 0] + i * spacing
                for j in range(low[1], high[1] + 1):
                    dy = local[1] - j * spacing
                    sy = origins[body, 1] + j * spacing
                    flat = dx * dx + dy * dy
                    if flat + outside[2] >= square:
                        continue
                    row = starts[body] + (i * sizes[body, 1] + j) * sizes[body, 2]
                    for k in range(low[2], high[2] + 1):
                        dz = local[2] - k * spacing
                        if not (filled[row + k] and flat + dz * dz < square):
                            continue
                        if found == of_body.shape[1]:
                            break
                        sz = origins[body, 2] + k * spacing
                        of_body[v, found] = body
                        for m in range(3):
                            now = x[body, m] + rot[body, m, 0] * sx
                            now = now + rot[body, m, 1] * sy + rot[body, m, 2] * sz
                            then = old_x[body, m] + old_rot[body, m, 0] * sx
                            then = then + old_rot[body, m, 1] * sy + old_rot[body, m, 2] * sz
                            position[v, found, m] = now
                            displacement[v, found, m] = now - then
                        found += 1
        counts[v] = found
