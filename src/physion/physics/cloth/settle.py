"""Settling of solids filled with particles: fall on the floor, and push each other apart.

The official cloth trials add solids one after the other, a little above the floor, and let them
settle for some frames each. Particles of two solids keep the rest distance, so a solid that is
added closer than that to another is thrown aside, and may fall over.

The method is that of Flex (see `solver`): contacts correct the particles of each solid, every one
by the mean of its corrections, and shape matching then moves the solid as a whole to the place that
fits the corrected particles best. For small corrections dp of n particles at r from the centre,
the best fit is the translation sum(dp) / n and the rotation J^-1 sum(r x dp), where J is the sum
of |r|^2 1 - r r^T (the inertia of particles of mass 1).
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import dot, inverse, ordered_mean, ordered_sum, unit
from physion.numerics.rotations import rotate_vectors, rotation_matrix
from physion.physics.cloth.contacts import MIN_DISTANCE, ClothOptions, friction_hold
from physion.physics.cloth.near_solids import (
    MAX_NEIGHBOURS,
    BodyPoses,
    Neighbours,
    Solids,
    find_neighbours,
    world_bounds,
)
from physion.physics.cloth.solids import fill_lattices, fill_shape
from physion.scenes.scene import Quat, Vec3

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

REST_SPEED = 0.001
"""Metres per second: while all particles are slower, solids count as settled."""


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
    - ``inverse`` (N, 3, 3): inverse of J (see above) in the frame of the solid, 1 / m^2.
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
def _place(state: SolidState, solids: SolidParticles, poses: BodyPoses) -> None:
    """Fill ``poses`` with those of the bodies whose solids have the given state."""
    for body in range(len(state.q)):
        rot = rotation_matrix(state.q[body])
        poses.rot[body] = rot
        for k in range(3):
            poses.x[body, k] = state.center[body, k]
            for m in range(3):
                poses.x[body, k] -= rot[k, m] * solids.center[body, m]


@kernel
def _world(
    state: SolidState, solids: SolidParticles, poses: BodyPoses, body: int, out: F64
) -> None:
    """Fill ``out`` (3, P) with the particles of a solid, metres, world."""
    for p in range(solids.first[body], solids.first[body + 1]):
        for k in range(3):
            out[k, p] = state.center[body, k]
            for m in range(3):
                out[k, p] += poses.rot[body, k, m] * solids.local[m, p]


@kernel
def settle(
    state: SolidState,
    added: int,
    solids: SolidParticles,
    lattices: Solids,
    options: ClothOptions,
    frames: int,
) -> int:
    """Let the first ``added`` solids settle; return how many frames it took, at most ``frames``.

    ``state`` is changed. It ends early once all particles are slower than `REST_SPEED`.
    """
    count = solids.local.shape[1]
    step = options.frame_time / options.substeps
    reach = options.rest_distance + options.search_margin
    near_floor = options.floor + options.floor_gap + options.search_margin
    bodies = len(state.q)
    points, start, here = np.zeros((3, count)), np.zeros((3, count)), np.zeros((3, count))
    poses = BodyPoses(np.zeros((bodies, 3)), np.zeros((bodies, 3, 3)))
    before = BodyPoses(np.zeros((bodies, 3)), np.zeros((bodies, 3, 3)))
    bounds = (np.empty((bodies, 3)), np.empty((bodies, 3)))
    others = (np.empty((bodies, 3)), np.empty((bodies, 3)))
    room = MAX_NEIGHBOURS
    near = Neighbours(
        np.zeros(count, np.int64),
        np.empty((count, room), np.int64),
        np.empty((count, room, 3)),
        np.empty((count, room, 3)),
        np.full((3, count), np.inf),
    )
    touching = np.empty(count, np.int64)
    shift, turned = np.empty(3), np.empty(3)
    old_center, old_q = state.center.copy(), state.q.copy()
    for frame in range(frames):
        for _ in range(options.substeps):
            _place(state, solids, before)
            old_center[:] = state.center
            old_q[:] = state.q
            for body in range(added):
                _world(state, solids, before, body, start)
                for k in range(3):
                    state.velocity[body, k] -= step * options.damping * state.velocity[body, k]
                    state.spin[body, k] -= step * options.damping * state.spin[body, k]
                state.velocity[body, 2] -= step * options.gravity
                for k in range(3):
                    state.center[body, k] += step * state.velocity[body, k]
                rotate_by(state.q[body], step * state.spin[body])
            _place(state, solids, poses)
            world_bounds(lattices, poses, reach, bounds[0], bounds[1])
            number = 0
            for body in range(added):
                _world(state, solids, poses, body, points)
                first, last = solids.first[body], solids.first[body + 1]
                others[0][:] = bounds[0]
                others[1][:] = bounds[1]
                for k in range(3):
                    others[0][body, k], others[1][body, k] = np.inf, -np.inf
                    for other in range(added, bodies):
                        others[0][other, k], others[1][other, k] = np.inf, -np.inf
                part = Neighbours(
                    near.counts[first:last],
                    near.body[first:last],
                    near.position[first:last],
                    near.displacement[first:last],
                    near.searched_at[:, first:last],
                )
                find_neighbours(
                    points[:, first:last], reach, -1.0, lattices, poses, before, others, part
                )
                for p in range(first, last):
                    if near.counts[p] > 0 or points[2, p] < near_floor:
                        touching[number] = p
                        number += 1
            # Where neighbours were found; their solids move on in the passes.
            found = BodyPoses(poses.x.copy(), poses.rot.copy())
            for _ in range(options.iterations):
                _pass(
                    state,
                    added,
                    solids,
                    options,
                    touching[:number],
                    near,
                    (start, here, poses, found),
                    (shift, turned),
                )
            for body in range(added):
                for k in range(3):
                    state.velocity[body, k] = (state.center[body, k] - old_center[body, k]) / step
                spin_between(old_q[body], state.q[body], step, state.spin[body])
        fastest = 0.0
        for body in range(added):
            speed = spin = 0.0
            for k in range(3):
                speed += state.velocity[body, k] ** 2
                spin += state.spin[body, k] ** 2
            fastest = max(fastest, np.sqrt(speed) + np.sqrt(spin) * solids.radius[body])
        if fastest < REST_SPEED:
            return frame + 1
    return frames


@kernel
def spin_between(old: F64, new: F64, step: float, out: F64) -> None:
    """Fill ``out`` (3,) with the spin in rad/s that turns ``old`` (4,) into ``new`` in ``step``."""
    w, x, y, z = new[0], new[1], new[2], new[3]
    a, b, c, d = old[0], -old[1], -old[2], -old[3]
    sign = 1.0 if w * a - x * b - y * c - z * d >= 0 else -1.0
    out[0] = sign * 2 * (w * b + x * a + y * d - z * c) / step
    out[1] = sign * 2 * (w * c - x * d + y * a + z * b) / step
    out[2] = sign * 2 * (w * d + x * c - y * b + z * a) / step


# Contact of two solid particles p and s of masses m_p, m_s: as for cloth (`contacts`), but p gets
# the fraction w_p / (w_p + w_s) of each correction, with w = 1 / m.


@kernel
def _pass(
    state: SolidState,
    added: int,
    solids: SolidParticles,
    options: ClothOptions,
    touching: I64,
    near: Neighbours,
    placed: tuple[F64, F64, BodyPoses, BodyPoses],
    work: tuple[F64, F64],
) -> None:
    """Make one pass over the contacts of all particles, then move each solid to the best fit."""
    start, here, poses, found = placed
    shift, turned = work
    rest_distance, rest_square = options.rest_distance, options.rest_distance**2
    x, rot, found_x, found_rot = poses.x, poses.rot, found.x, found.rot
    weight, center = solids.weight, state.center
    _place(state, solids, poses)
    total = np.zeros((added, 3))
    moment = np.zeros((added, 3))
    # Where each solid has moved since the search: p_now = move p_found + shift_of.
    move = np.zeros((added, 3, 3))
    offset = np.zeros((added, 3))
    for b in range(added):
        for k in range(3):
            for m in range(3):
                for j in range(3):
                    move[b, k, m] += rot[b, k, j] * found_rot[b, m, j]
            offset[b, k] = x[b, k]
            for m in range(3):
                offset[b, k] -= move[b, k, m] * found_x[b, m]
    body = 0
    for p in touching:
        while p >= solids.first[body + 1]:
            body += 1
        for k in range(3):
            here[k, p] = center[body, k]
            for m in range(3):
                here[k, p] += rot[body, k, m] * solids.local[m, p]
        px, py, pz = here[0, p], here[1, p], here[2, p]
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
    for b in range(added):
        number = solids.first[b + 1] - solids.first[b]
        for k in range(3):
            center[b, k] += total[b, k] / number
            shift[k] = 0.0
            for m in range(3):
                shift[k] += rot[b, m, k] * moment[b, m]
        for k in range(3):
            turned[k] = 0.0
            for m in range(3):
                for j in range(3):
                    turned[k] += rot[b, k, m] * solids.inverse[b, m, j] * shift[j]
        rotate_by(state.q[b], turned)


@lru_cache(maxsize=64)
def settled_poses(
    bodies: tuple[SolidBody, ...], options: ClothOptions, spacing: float, frames: int
) -> tuple[tuple[Vec3, Quat], ...]:
    """Return position and rotation (w, x, y, z) of solids that settled one after the other.

    A solid that keeps the rest distance from those before it falls straight down and stands on the
    floor. Otherwise all that were added so far settle for ``frames`` frames, or until they rest.

    Parameters
    ----------
    bodies : tuple of SolidBody
        In the order in which they are added.
    options : ClothOptions
        Distances, friction, gravity.
    spacing : float
        Metres between the particles of a solid.
    frames : int
        Frames for each.
    """
    lattices = fill_lattices([(body.shape, body.scale) for body in bodies], spacing)
    solids = solid_particles(bodies, spacing)
    rotations = np.array([unit(body.rotation) for body in bodies])
    state = SolidState(
        np.array([body.position for body in bodies]) + rotate_vectors(rotations, solids.center),
        rotations.copy(),
        np.zeros((len(bodies), 3)),
        np.zeros((len(bodies), 3)),
    )
    resting = True
    for number in range(len(bodies)):
        touches = _comes_close(state, number, solids, lattices, options)
        lowest = _lowest(state, number, solids)
        if resting and not touches:
            state.center[number, 2] += options.floor + options.floor_gap - lowest
            if not _comes_close(state, number, solids, lattices, options):
                continue
            state.center[number, 2] += lowest - options.floor - options.floor_gap
        resting = settle(state, number + 1, solids, lattices, options, frames) < frames
    turned = rotate_vectors(state.q, solids.center)
    return tuple(
        (tuple(x), tuple(q))
        for x, q in zip((state.center - turned).tolist(), state.q.tolist(), strict=True)
    )


def solid_particles(bodies: tuple[SolidBody, ...], spacing: float) -> SolidParticles:
    """Return the particles of solids."""
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


def _comes_close(
    state: SolidState,
    number: int,
    solids: SolidParticles,
    lattices: Solids,
    options: ClothOptions,
) -> bool:
    """Return whether a solid is closer than the rest distance to one that was added before."""
    count = len(solids.center)
    poses = BodyPoses(np.zeros((count, 3)), np.zeros((count, 3, 3)))
    _place(state, solids, poses)
    points = np.zeros_like(solids.local)
    _world(state, solids, poses, number, points)
    points = np.ascontiguousarray(points[:, solids.first[number] : solids.first[number + 1]])
    bounds = (np.empty((count, 3)), np.empty((count, 3)))
    world_bounds(lattices, poses, options.rest_distance, bounds[0], bounds[1])
    bounds[0][number:], bounds[1][number:] = np.inf, -np.inf
    particles = points.shape[1]
    near = Neighbours(
        np.zeros(particles, np.int64),
        np.empty((particles, 1), np.int64),
        np.empty((particles, 1, 3)),
        np.empty((particles, 1, 3)),
        np.full((3, particles), np.inf),
    )
    find_neighbours(points, options.rest_distance, -1.0, lattices, poses, poses, bounds, near)
    return bool(near.counts.any())


def _lowest(state: SolidState, number: int, solids: SolidParticles) -> float:
    """Return the height of the lowest particle of a solid, metres."""
    local = solids.local[:, solids.first[number] : solids.first[number + 1]].T
    return float(rotate_vectors(state.q[number], local)[:, 2].min() + state.center[number, 2])
