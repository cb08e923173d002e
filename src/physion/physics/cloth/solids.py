"""Rigid bodies filled with cubic lattices of particles, as in NVIDIA Flex.

`fill_shape` makes the lattice of a shape. While bodies settle before a cloth falls, they move as
solids of particles: `correct_solids` parts those that come too close.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadSceneError
from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import dot, inverse, multiply, norm, ordered_mean, ordered_sum
from physion.numerics.rotations import rotation_matrix
from physion.physics.cloth.contacts import (
    MIN_DISTANCE,
    BodyPoses,
    ClothOptions,
    Neighbours,
    Solids,
    friction_hold,
    new_poses,
)
from physion.scenes.scene import Body, Quat, Vec3
from physion.scenes.shapes.primitives import ConvexPiece, shape

F64 = NDArray[np.float64]
Filled = NDArray[np.bool_]
I64 = NDArray[np.int64]

MOST_A_SIDE = 32767
"""Most particles along a side of a lattice: their indices are 16-bit integers."""


@lru_cache(maxsize=256)
def fill_shape(name: str, scale: Vec3, spacing: float) -> tuple[F64, Filled]:
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
def _planes(name: str, number: int) -> F64:
    """Return the faces (K, 4) of a convex piece of a shape: unit normal out, and offset."""
    # Imported late: what only reads scenes and trials starts faster.
    from scipy.spatial import ConvexHull

    return np.ascontiguousarray(ConvexHull(shape(name).pieces[number].vertices).equations)


@kernel
def _fill_convex(points: F64, planes: F64, filled: Filled) -> None:
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


def _inside(piece: ConvexPiece, points: F64) -> Filled:
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


def particles_of(body: Body, spacing: float) -> F64:
    """Return the particles (P, 3) of a body in its own frame, metres; its pose is not applied."""
    origin, filled = fill_shape(body.shape, body.scale, spacing)
    return np.asarray(origin + spacing * np.argwhere(filled))


def surface_particles(body: Body, spacing: float) -> F64:
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
    """Return the lattices of shapes at their scales; None stands for an empty one.

    Raises `BadSceneError` for a lattice with more than `MOST_A_SIDE` points along a side.
    """
    lattices = [
        (np.zeros(3), np.zeros((0, 0, 0), np.bool_))
        if found is None
        else fill_shape(found[0], found[1], spacing)
        for found in shapes
    ]
    for found, (_, filled) in zip(shapes, lattices, strict=True):
        if found is not None and max(filled.shape) > MOST_A_SIDE:
            raise BadSceneError(
                f"body of shape {found[0]!r} has {max(filled.shape)} particles along a side, more "
                f"than {MOST_A_SIDE}; beside cloth make it smaller, or scenery"
            )
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


# Solids filled with particles that move as a whole: records, particles, poses and rotations.


class SolidBody(NamedTuple):
    """What of a body decides how it settles: shape and factors, pose, mass in kg."""

    shape: str
    scale: Vec3
    position: Vec3
    rotation: Quat
    mass: float


class SolidParticles(NamedTuple):
    """Particles of N solids, P in all, each solid's in one block.

    - ``first`` (N + 1,): where the block of each solid begins.
    - ``local`` (3, P): metres from the centre of the solid's particles, in its frame.
    - ``center`` (N, 3): that centre in the frame of the body, metres.
    - ``inverse`` (N, 3, 3): inverse of J (see `solid_contacts`) in the frame of the solid, 1 / m^2.
    - ``weight`` (N,): one over the mass of a particle, 1 / kg.
    - ``radius`` (N,): distance from the centre to the farthest particle, metres.
    """

    first: I64
    local: F64
    center: F64
    inverse: F64
    weight: F64
    radius: F64


class SolidState(NamedTuple):
    """State of N solids: centres (N, 3), quaternions (N, 4), velocities (N, 3), spins (N, 3)."""

    center: F64
    q: F64
    velocity: F64
    spin: F64


def solid_particles(bodies: tuple[SolidBody, ...], spacing: float) -> SolidParticles:
    """Return the particles of solids, ``spacing`` metres apart."""
    clouds, centers, inverses, weights, radii = [], [], [], [], []
    for body in bodies:
        origin, filled = fill_shape(body.shape, body.scale, spacing)
        cloud = origin + spacing * np.argwhere(filled)
        center = ordered_mean(cloud, axis=0)
        cloud = cloud - center
        squares = dot(cloud, cloud)
        spread = ordered_sum(
            squares[:, None, None] * np.eye(3) - cloud[:, :, None] * cloud[:, None, :], axis=0
        )
        # A row of particles has no inertia about itself; that of their size makes J regular.
        spread = spread + len(cloud) * (spacing / 2) ** 2 * np.eye(3)
        clouds.append(cloud)
        centers.append(center)
        inverses.append(inverse(spread))
        weights.append(len(cloud) / body.mass)
        radii.append(float(np.sqrt(squares.max())))
    ends = np.cumsum([len(cloud) for cloud in clouds])
    return SolidParticles(
        np.concatenate([[0], ends]).astype(np.int64),
        np.ascontiguousarray(np.concatenate(clouds).T),
        np.array(centers),
        np.array(inverses),
        np.array(weights),
        np.array(radii),
    )


@kernel
def place_bodies(state: SolidState, solids: SolidParticles, poses: BodyPoses) -> None:
    """Fill ``poses`` with those of the bodies whose solids have the given state."""
    for body in range(len(state.q)):
        rot = rotation_matrix(state.q[body])
        poses.rot[body] = rot
        for k in range(3):
            poses.x[body, k] = state.center[body, k]
            for m in range(3):
                poses.x[body, k] -= rot[k, m] * solids.center[body, m]


@kernel
def place_particles(
    state: SolidState, solids: SolidParticles, poses: BodyPoses, body: int, out: F64
) -> None:
    """Fill ``out`` (3, P) with the particles of a solid, metres, world."""
    for p in range(solids.first[body], solids.first[body + 1]):
        for k in range(3):
            out[k, p] = state.center[body, k]
            for m in range(3):
                out[k, p] += poses.rot[body, k, m] * solids.local[m, p]


@kernel
def rotate_by(q: F64, angle: F64) -> None:
    """Rotate a quaternion (4,) by a small rotation vector ``angle`` (3,) of the world, radians."""
    half = 0.5 * angle
    w, x, y, z = q[0], q[1], q[2], q[3]
    q[0] = w - half[0] * x - half[1] * y - half[2] * z
    q[1] = x + half[0] * w + half[1] * z - half[2] * y
    q[2] = y + half[1] * w + half[2] * x - half[0] * z
    q[3] = z + half[2] * w + half[0] * y - half[1] * x
    length = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    for k in range(4):
        q[k] /= length


@kernel
def spin_between(old: F64, new: F64, step: float, out: F64) -> None:
    """Fill ``out`` (3,) with the spin in rad/s that turns ``old`` (4,) into ``new`` in ``step``."""
    w, x, y, z = new[0], new[1], new[2], new[3]
    a, b, c, d = old[0], -old[1], -old[2], -old[3]
    sign = 1.0 if w * a - x * b - y * c - z * d >= 0 else -1.0
    out[0] = sign * 2 * (w * b + x * a + y * d - z * c) / step
    out[1] = sign * 2 * (w * c - x * d + y * a + z * b) / step
    out[2] = sign * 2 * (w * d + x * c - y * b + z * a) / step


# Contacts of solids filled with particles: corrections of particles, and the best fit to them.
#
# Contacts correct the particles of each solid, every one by the mean of its corrections, and shape
# matching then moves the solid as a whole to the place that fits the corrected particles best. For
# small corrections dp of n particles at r from the centre, the best fit is the translation sum(dp)
# / n and the rotation J^-1 sum(r x dp), where J is the sum of |r|^2 1 - r r^T (the inertia of
# particles of mass 1).

# Contact of two solid particles p and s of masses m_p, m_s: as for cloth (`contacts`), but p gets
# the fraction w_p / (w_p + w_s) of each correction, with w = 1 / m.


@kernel
def correct_solids(
    state: SolidState,
    added: int,
    solids: SolidParticles,
    options: ClothOptions,
    touching: I64,
    near: Neighbours,
    start: F64,
    searched: BodyPoses,
) -> None:
    """Make one pass over the contacts of all particles, then move each solid to the best fit.

    Parameters
    ----------
    state : SolidState
        Centres and rotations are changed.
    added : int
        Number of solids that are there: the first ones.
    solids, options
        Particles of all solids; distances and friction.
    touching : (T,)
        Particles that may touch something, in ascending order.
    near : Neighbours
        Solid particles near each particle, as they were searched.
    start : (3, P)
        Particles before the substep, metres, world.
    searched : BodyPoses
        Poses with which ``near`` was searched.
    """
    rest_distance, rest_square = options.rest_distance, options.rest_distance**2
    weight, center = solids.weight, state.center
    poses = new_poses(len(state.q))
    place_bodies(state, solids, poses)
    rot = poses.rot
    move, offset = _motion_since(searched, poses, added)
    total, moment = np.zeros((added, 3)), np.zeros((added, 3))
    here = np.empty(3)
    body = 0
    for p in touching:
        while p >= solids.first[body + 1]:
            body += 1
        for k in range(3):
            here[k] = center[body, k]
            for m in range(3):
                here[k] += rot[body, k, m] * solids.local[m, p]
        px, py, pz = here[0], here[1], here[2]
        mx, my, mz = px - start[0, p], py - start[1, p], pz - start[2, p]
        sx = sy = sz = 0.0
        contacts = 0
        for c in range(near.counts[p]):
            b = near.body[p, c]
            fx, fy, fz = near.position[p, c, 0], near.position[p, c, 1], near.position[p, c, 2]
            qx = offset[b, 0] + move[b, 0, 0] * fx + move[b, 0, 1] * fy + move[b, 0, 2] * fz
            qy = offset[b, 1] + move[b, 1, 0] * fx + move[b, 1, 1] * fy + move[b, 1, 2] * fz
            qz = offset[b, 2] + move[b, 2, 0] * fx + move[b, 2, 1] * fy + move[b, 2, 2] * fz
            dx, dy, dz = px - qx, py - qy, pz - qz
            square = dx * dx + dy * dy + dz * dz
            if square >= rest_square:
                continue
            distance = np.sqrt(square)
            if distance < MIN_DISTANCE:
                continue
            fraction = weight[body] / (weight[body] + weight[b])
            depth = rest_distance - distance
            dx, dy, dz = dx / distance, dy / distance, dz / distance
            ux = mx - near.displacement[p, c, 0] - (qx - fx)
            uy = my - near.displacement[p, c, 1] - (qy - fy)
            uz = mz - near.displacement[p, c, 2] - (qz - fz)
            along = ux * dx + uy * dy + uz * dz
            ux, uy, uz = ux - along * dx, uy - along * dy, uz - along * dz
            hold = friction_hold(ux * ux + uy * uy + uz * uz, options.friction * depth)
            sx += fraction * (dx * depth - hold * ux)
            sy += fraction * (dy * depth - hold * uy)
            sz += fraction * (dz * depth - hold * uz)
            contacts += 1
        depth = options.floor + options.floor_gap - pz
        if depth > 0:
            hold = friction_hold(mx * mx + my * my, options.floor_friction * depth)
            sx -= hold * mx
            sy -= hold * my
            sz += depth
            contacts += 1
        if contacts:
            sx, sy, sz = sx / contacts, sy / contacts, sz / contacts
            total[body, 0] += sx
            total[body, 1] += sy
            total[body, 2] += sz
            rx, ry, rz = px - center[body, 0], py - center[body, 1], pz - center[body, 2]
            moment[body, 0] += ry * sz - rz * sy
            moment[body, 1] += rz * sx - rx * sz
            moment[body, 2] += rx * sy - ry * sx
    _move_to_fit(state, solids, rot, total, moment)


@kernel
def _motion_since(then: BodyPoses, now: BodyPoses, count: int) -> tuple[F64, F64]:
    """Return how the first ``count`` bodies moved between two poses.

    A point p of body b has moved to move[b] p + offset[b]: ``move`` (count, 3, 3) is a rotation,
    ``offset`` (count, 3) is in metres.
    """
    move, offset = np.zeros((count, 3, 3)), np.zeros((count, 3))
    for b in range(count):
        for k in range(3):
            for m in range(3):
                for j in range(3):
                    move[b, k, m] += now.rot[b, k, j] * then.rot[b, m, j]
            offset[b, k] = now.x[b, k]
            for m in range(3):
                offset[b, k] -= move[b, k, m] * then.x[b, m]
    return move, offset


@kernel
def _move_to_fit(
    state: SolidState, solids: SolidParticles, rot: F64, total: F64, moment: F64
) -> None:
    """Move solids, which are rotated by ``rot`` (N, 3, 3), to the best fit to their corrections.

    ``total`` (M, 3) is the sum of the corrections of the first M solids, metres, ``moment`` (M, 3)
    their moment about the centre of the solid, m^2.
    """
    center = state.center
    local, angle = np.empty(3), np.empty(3)
    for b in range(len(total)):
        number = solids.first[b + 1] - solids.first[b]
        for k in range(3):
            center[b, k] += total[b, k] / number
            local[k] = 0.0
            for m in range(3):
                local[k] += rot[b, m, k] * moment[b, m]
        for k in range(3):
            angle[k] = 0.0
            for m in range(3):
                for j in range(3):
                    angle[k] += rot[b, k, m] * solids.inverse[b, m, j] * local[j]
        rotate_by(state.q[b], angle)
