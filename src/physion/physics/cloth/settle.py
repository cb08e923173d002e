"""Settling of solids filled with particles: fall on the floor, and push each other apart.

The official cloth trials add solids one after the other, a little above the floor, and let them
settle for some frames each. Particles of two solids keep the rest distance, so a solid that is
added closer than that to another is thrown aside, and may fall over.

The method is that of Flex (see `solver`): solids move freely in every substep, and passes over
their contacts (`solid_contacts`) then correct them.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import unit
from physion.numerics.rotations import rotate_vectors
from physion.physics.cloth.contacts import ClothOptions
from physion.physics.cloth.near_solids import (
    MAX_NEIGHBOURS,
    BodyPoses,
    Neighbours,
    Solids,
    find_neighbours,
    new_neighbours,
    new_poses,
    world_bounds,
)
from physion.physics.cloth.solid_contacts import correct_solids
from physion.physics.cloth.solid_motion import (
    SolidBody,
    SolidParticles,
    SolidState,
    place_bodies,
    place_particles,
    rotate_by,
    solid_particles,
    spin_between,
)
from physion.physics.cloth.solids import fill_lattices
from physion.scenes.scene import Quat, Vec3

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

REST_SPEED = 0.001
"""Metres per second: while all particles are slower, solids count as settled."""


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
    step = options.frame_time / options.substeps
    count, bodies = solids.local.shape[1], len(state.q)
    start, touching = np.zeros((3, count)), np.empty(count, np.int64)
    near = new_neighbours(count, MAX_NEIGHBOURS)
    before, poses = new_poses(bodies), new_poses(bodies)
    old_center, old_q = state.center.copy(), state.q.copy()
    for frame in range(frames):
        for _ in range(options.substeps):
            place_bodies(state, solids, before)
            old_center[:] = state.center
            old_q[:] = state.q
            for body in range(added):
                place_particles(state, solids, before, body, start)
                _fall(state, body, step, options)
            place_bodies(state, solids, poses)
            number = _search_solids(
                state, added, solids, lattices, options, poses, before, near, touching
            )
            for _ in range(options.iterations):
                correct_solids(state, added, solids, options, touching[:number], near, start, poses)
            for body in range(added):
                for k in range(3):
                    state.velocity[body, k] = (state.center[body, k] - old_center[body, k]) / step
                spin_between(old_q[body], state.q[body], step, state.spin[body])
        if _fastest(state, solids, added) < REST_SPEED:
            return frame + 1
    return frames


@kernel
def _fall(state: SolidState, body: int, step: float, options: ClothOptions) -> None:
    """Move a solid by ``step`` seconds of gravity and drag alone."""
    for k in range(3):
        state.velocity[body, k] -= step * options.damping * state.velocity[body, k]
        state.spin[body, k] -= step * options.damping * state.spin[body, k]
    state.velocity[body, 2] -= step * options.gravity
    for k in range(3):
        state.center[body, k] += step * state.velocity[body, k]
    rotate_by(state.q[body], step * state.spin[body])


@kernel
def _search_solids(
    state: SolidState,
    added: int,
    solids: SolidParticles,
    lattices: Solids,
    options: ClothOptions,
    poses: BodyPoses,
    before: BodyPoses,
    near: Neighbours,
    touching: I64,
) -> int:
    """Search the neighbours of all particles among the other solids; return how many may touch.

    ``poses`` and ``before`` are those at the end and at the start of the substep. ``near`` is
    filled, and ``touching`` (P,) with the particles that have neighbours or the floor near them.
    """
    reach = options.rest_distance + options.search_margin
    near_floor = options.floor + options.floor_gap + options.search_margin
    bodies = len(state.q)
    points = np.zeros(solids.local.shape)
    bounds = (np.empty((bodies, 3)), np.empty((bodies, 3)))
    others = (np.empty((bodies, 3)), np.empty((bodies, 3)))
    world_bounds(lattices, poses, reach, bounds[0], bounds[1])
    number = 0
    for body in range(added):
        place_particles(state, solids, poses, body, points)
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
        find_neighbours(points[:, first:last], reach, -1.0, lattices, poses, before, others, part)
        for p in range(first, last):
            if near.counts[p] > 0 or points[2, p] < near_floor:
                touching[number] = p
                number += 1
    return number


@kernel
def _fastest(state: SolidState, solids: SolidParticles, added: int) -> float:
    """Return the largest speed that a particle of the first ``added`` solids can have, m/s."""
    fastest = 0.0
    for body in range(added):
        speed = spin = 0.0
        for k in range(3):
            speed += state.velocity[body, k] ** 2
            spin += state.spin[body, k] ** 2
        fastest = max(fastest, np.sqrt(speed) + np.sqrt(spin) * solids.radius[body])
    return fastest


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


def _comes_close(
    state: SolidState,
    number: int,
    solids: SolidParticles,
    lattices: Solids,
    options: ClothOptions,
) -> bool:
    """Return whether a solid is closer than the rest distance to one that was added before."""
    count = len(solids.center)
    poses = new_poses(count)
    place_bodies(state, solids, poses)
    points = np.zeros_like(solids.local)
    place_particles(state, solids, poses, number, points)
    points = np.ascontiguousarray(points[:, solids.first[number] : solids.first[number + 1]])
    bounds = (np.empty((count, 3)), np.empty((count, 3)))
    world_bounds(lattices, poses, options.rest_distance, bounds[0], bounds[1])
    bounds[0][number:], bounds[1][number:] = np.inf, -np.inf
    near = new_neighbours(points.shape[1], 1)
    find_neighbours(points, options.rest_distance, -1.0, lattices, poses, poses, bounds, near)
    return bool(near.counts.any())


def _lowest(state: SolidState, number: int, solids: SolidParticles) -> float:
    """Return the height of the lowest particle of a solid, metres."""
    local = solids.local[:, solids.first[number] : solids.first[number + 1]].T
    return float(rotate_vectors(state.q[number], local)[:, 2].min() + state.center[number, 2])
