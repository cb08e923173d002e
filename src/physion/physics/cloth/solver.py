"""Cloth solver: position-based dynamics of particles, in compiled loops.

The scheme is that of NVIDIA Flex. A substep of length h moves every particle freely and then
corrects positions until the constraints hold nearly:

    v  <- v - h d v - h g z                     drag d, gravity g
    p  <- x + h v                               prediction; x is the position before the substep
    repeat ``iterations`` times:                Jacobi passes
        for every constraint C that is violated at p: collect corrections
        p <- p + (sum of corrections) / (number of constraints)       for each particle
    v  <- (p - x) / h
    x  <- p

Averaging in place of summing keeps Jacobi passes stable, at the price of slower convergence: a
cloth stays a little elastic, and a contact a little soft. That is wanted here, see `simulate`.

Everything runs in one fixed order on one core, without fastmath: equal input, equal bytes.

References
----------
M. Müller, B. Heidelberger, M. Hennix, J. Ratcliff: Position Based Dynamics. Journal of Visual
Communication and Image Representation 18, 2007.
M. Macklin, M. Müller, N. Chentanez, T.-Y. Kim: Unified Particle Physics for Real-Time Applications.
ACM Transactions on Graphics 33 (4), 2014.
"""

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
MIN_DISTANCE = 1e-9
"""Metres between a cloth particle and a solid one below which a contact has no direction."""
MIN_LENGTH = 1e-12
"""Metres below which a spring or a slip has no direction."""


class Springs(NamedTuple):
    """S distance constraints between pairs of particles.

    ``ends`` (S, 2) particle indices, ``lengths`` (S,) metres at rest, ``stiffness`` (S,) fraction
    of the error that one pass removes.
    """

    ends: I64
    lengths: F64
    stiffness: F64


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


class MovingSolids(NamedTuple):
    """Rigid bodies whose motion is given.

    - ``solids``: the particles of N bodies.
    - ``positions`` (F, N, 3) metres, ``rotations`` (F, N, 4) quaternions (w, x, y, z): their poses.
    - ``watched``: the body whose distance to the cloth is recorded, -1 for none.
    - ``watched_particles`` (P, 3): its surface particles, in its own frame.
    """

    solids: Solids
    positions: F64
    rotations: F64
    watched: int
    watched_particles: F64


class BodyPoses(NamedTuple):
    """Poses of N bodies: positions ``x`` (N, 3) in metres, rotation matrices ``rot`` (N, 3, 3)."""

    x: F64
    rot: F64


class Neighbours(NamedTuple):
    """Solid particles near each of V cloth particles, K at most.

    ``counts`` (V,) how many; ``body`` (V, K) the body of each; ``position`` (V, K, 3) metres,
    world; ``displacement`` (V, K, 3) metres that it moved during the substep.
    """

    counts: I64
    body: I64
    position: F64
    displacement: F64


class ClothOptions(NamedTuple):
    """Numbers of the simulation in SI units; see `physion.physics.cloth.simulate.ClothSettings`.

    ``floor``: height of the floor in metres.
    """

    frame_time: float
    substeps: int
    iterations: int
    rest_distance: float
    search_margin: float
    floor: float
    floor_gap: float
    friction: float
    floor_friction: float
    damping: float
    gravity: float


class Corrections(NamedTuple):
    """Corrections of one pass over V particles.

    ``total`` (V, 3) metres, summed; ``constraint_count`` (V,) how many were summed.
    """

    total: F64
    constraint_count: F64


class ClothRecord(NamedTuple):
    """Output of a simulation of F frames; N + 1 stands for N bodies and, last, the floor.

    - ``vertices`` (F, V, 3): metres.
    - ``distance`` (F,): metres between particles of the cloth and of the watched body.
    - ``gap`` (F, N + 1): smallest gap in metres.
    - ``contact`` (F, N + 1, 2, 3): point of that gap, and its normal towards the cloth.
    - ``normal_correction`` (F, N + 1): metres that contacts moved particles, summed.
    """

    vertices: F64
    distance: F64
    gap: F64
    contact: F64
    normal_correction: F64


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


# Contact search: a cloth particle is taken into the frame of each body, where the lattice cells
# within ``reach`` are a small box of indices. It is done once a substep, at the predicted
# positions, as in algorithm 1 of Macklin et al. 2014 (who use a hash grid).


@kernel
def find_neighbours(
    points: F64, reach: float, solids: Solids, poses: BodyPoses, old: BodyPoses, near: Neighbours
) -> None:
    """Fill ``near`` with the solid particles within ``reach`` of every cloth particle.

    Parameters
    ----------
    points : (V, 3)
        Cloth particles, metres, world.
    reach : float
        Metres.
    solids, poses, old
        Solid particles; poses of the bodies at the end and at the start of the substep.
    near : Neighbours
        Is filled; at most `MAX_NEIGHBOURS` a particle, in the order of bodies.
    """
    local, spot = np.empty(3), np.empty(3)
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    spacing, square = solids.spacing, reach * reach
    for v in range(len(points)):
        near.counts[v] = 0
        for body in range(len(solids.origins)):
            to_local(points[v], poses.x[body], poses.rot[body], local)
            far = False
            for k in range(3):
                local[k] -= solids.origins[body, k]
                low[k] = max(int(np.ceil((local[k] - reach) / spacing)), 0)
                high[k] = min(
                    int(np.floor((local[k] + reach) / spacing)), solids.sizes[body, k] - 1
                )
                far = far or low[k] > high[k]
            if far:
                continue
            for i in range(low[0], high[0] + 1):
                dx = local[0] - i * spacing
                for j in range(low[1], high[1] + 1):
                    dy = local[1] - j * spacing
                    flat = dx * dx + dy * dy
                    if flat >= square:
                        continue
                    row = solids.starts[body]
                    row += (i * solids.sizes[body, 1] + j) * solids.sizes[body, 2]
                    for k in range(low[2], high[2] + 1):
                        dz = local[2] - k * spacing
                        if solids.filled[row + k] and flat + dz * dz < square:
                            spot[0] = solids.origins[body, 0] + i * spacing
                            spot[1] = solids.origins[body, 1] + j * spacing
                            spot[2] = solids.origins[body, 2] + k * spacing
                            _add_neighbour(v, body, spot, poses, old, near)


@kernel
def _add_neighbour(
    v: int, body: int, spot: F64, poses: BodyPoses, old: BodyPoses, near: Neighbours
) -> None:
    """Add the solid particle at ``spot`` (3,), in its body's frame, unless the list is full."""
    found = near.counts[v]
    if found == near.body.shape[1]:
        return
    near.counts[v] = found + 1
    near.body[v, found] = body
    for m in range(3):
        now, then = poses.x[body, m], old.x[body, m]
        for n in range(3):
            now += poses.rot[body, m, n] * spot[n]
            then += old.rot[body, m, n] * spot[n]
        near.position[v, found, m] = now
        near.displacement[v, found, m] = now - then


# Contact and friction. For a cloth particle p and a solid particle s, with r = |p - s|, rest
# distance r0 and n = (p - s) / r, the constraint is C = r - r0 >= 0. Where it is violated by the
# depth d = -C, the particle alone moves, since bodies do not give way:
#     dp = d n - min(1, mu d / |u|) u,
# where u is the tangential part of its slip against s in this substep, (p - x) - (s - s_old). The
# second term is Coulomb friction on positions: it takes back all of a slip shorter than mu d and mu
# d of a longer one (the friction model of Macklin et al. 2014, with one coefficient for rest and
# sliding). The floor is a plane with C = p_z - (floor + gap).


@kernel
def correct_contacts(
    points: F64, start: F64, near: Neighbours, options: ClothOptions, corrections: Corrections
) -> None:
    """Add the corrections that move particles out of solids and the floor, against their slip.

    Parameters
    ----------
    points, start : (V, 3)
        Positions now, and before the substep; metres.
    near, options
        Solid particles that may touch; distances and friction.
    corrections : Corrections
        Is added to.
    """
    shift, constraint_count = corrections.total, corrections.constraint_count
    rest_distance = options.rest_distance
    for v in range(len(points)):
        for c in range(near.counts[v]):
            dx = points[v, 0] - near.position[v, c, 0]
            dy = points[v, 1] - near.position[v, c, 1]
            dz = points[v, 2] - near.position[v, c, 2]
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            if distance >= rest_distance or distance < 1e-9:
                continue
            depth = rest_distance - distance
            dx, dy, dz = dx / distance, dy / distance, dz / distance
            ux = points[v, 0] - start[v, 0] - near.displacement[v, c, 0]
            uy = points[v, 1] - start[v, 1] - near.displacement[v, c, 1]
            uz = points[v, 2] - start[v, 2] - near.displacement[v, c, 2]
            along = ux * dx + uy * dy + uz * dz
            ux, uy, uz = ux - along * dx, uy - along * dy, uz - along * dz
            slip = np.sqrt(ux * ux + uy * uy + uz * uz)
            hold = min(1.0, options.friction * depth / slip) if slip > 1e-12 else 0.0
            shift[v, 0] += dx * depth - hold * ux
            shift[v, 1] += dy * depth - hold * uy
            shift[v, 2] += dz * depth - hold * uz
            constraint_count[v] += 1
        depth = options.floor + options.floor_gap - points[v, 2]
        if depth > 0:
            ux, uy = points[v, 0] - start[v, 0], points[v, 1] - start[v, 1]
            slip = np.sqrt(ux * ux + uy * uy)
            hold = min(1.0, options.floor_friction * depth / slip) if slip > 1e-12 else 0.0
            shift[v, 0] -= hold * ux
            shift[v, 1] -= hold * uy
            shift[v, 2] += depth
            constraint_count[v] += 1


# Contact impulse. A correction by dp within a substep h is a change of velocity by dp / h. The sum
# over all passes of d / (number of constraints) is what contacts moved the particles of a cloth.


@kernel
def add_normal_corrections(
    points: F64,
    near: Neighbours,
    options: ClothOptions,
    constraint_count: F64,
    normal_correction: F64,
) -> None:
    """Add how far contacts are about to move particles along their normals, by body.

    To be called when all constraints are counted, before the corrections are applied.

    Parameters
    ----------
    points : (V, 3)
        Positions, metres.
    near, options
        As in `correct_contacts`.
    constraint_count : (V,)
        Of `Corrections`.
    normal_correction : (N + 1,)
        Metres by body and, last, for the floor; is added to.
    """
    rest_distance = options.rest_distance
    for v in range(len(points)):
        for c in range(near.counts[v]):
            dx = points[v, 0] - near.position[v, c, 0]
            dy = points[v, 1] - near.position[v, c, 1]
            dz = points[v, 2] - near.position[v, c, 2]
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            if 1e-9 < distance < rest_distance:
                normal_correction[near.body[v, c]] += (rest_distance - distance) / constraint_count[
                    v
                ]
        depth = options.floor + options.floor_gap - points[v, 2]
        if depth > 0:
            normal_correction[-1] += depth / constraint_count[v]


# Springs: C = |p_b - p_a| - l. Both ends have one mass, so each gets half of the error, times the
# stiffness k:  dp_a = k/2 C (p_b - p_a) / |p_b - p_a| = -dp_b  (Müller et al. 2007, section 3.3).


@kernel
def correct_springs(points: F64, springs: Springs, corrections: Corrections) -> None:
    """Add the corrections that bring each spring back to its length.

    ``points`` (V, 3) are positions in metres; ``corrections`` is added to.
    """
    shift, constraint_count = corrections.total, corrections.constraint_count
    for s in range(len(springs.ends)):
        a, b = springs.ends[s, 0], springs.ends[s, 1]
        dx = points[b, 0] - points[a, 0]
        dy = points[b, 1] - points[a, 1]
        dz = points[b, 2] - points[a, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if length < 1e-12:
            continue
        half = 0.5 * springs.stiffness[s] * (length - springs.lengths[s]) / length
        shift[a, 0] += half * dx
        shift[a, 1] += half * dy
        shift[a, 2] += half * dz
        shift[b, 0] -= half * dx
        shift[b, 1] -= half * dy
        shift[b, 2] -= half * dz
        constraint_count[a] += 1
        constraint_count[b] += 1


# Averaging: p <- p + (sum of corrections) / n  (constraint averaging of Macklin et al. 2014, with a
# relaxation factor of 1). n counts every constraint of the particle, contacts and springs alike.


@kernel
def apply_average(points: F64, corrections: Corrections) -> None:
    """Move every particle (V, 3) by the mean of its corrections, and clear them."""
    shift, constraint_count = corrections.total, corrections.constraint_count
    for v in range(len(points)):
        if constraint_count[v] > 0:
            for k in range(3):
                points[v, k] += shift[v, k] / constraint_count[v]
                shift[v, k] = 0.0
            constraint_count[v] = 0.0


@kernel
def record_gaps(
    points: F64, near: Neighbours, options: ClothOptions, gap: F64, contact: F64
) -> None:
    """Lower ``gap`` to the smallest gap between the cloth and each body and, last, the floor.

    Parameters
    ----------
    points, near, options
        As in `correct_contacts`.
    gap : (N + 1,)
        Metres; a gap is the distance of particles less the rest distance.
    contact : (N + 1, 2, 3)
        Gets the point on the cloth's underside, and the normal towards the cloth.
    """
    rest_distance = options.rest_distance
    for v in range(len(points)):
        for c in range(near.counts[v]):
            dx = points[v, 0] - near.position[v, c, 0]
            dy = points[v, 1] - near.position[v, c, 1]
            dz = points[v, 2] - near.position[v, c, 2]
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            body = near.body[v, c]
            if distance - rest_distance < gap[body] and distance > 1e-9:
                gap[body] = distance - rest_distance
                for k in range(3):
                    contact[body, 1, k] = (points[v, k] - near.position[v, c, k]) / distance
                    contact[body, 0, k] = points[v, k] - rest_distance * contact[body, 1, k]
        height = points[v, 2] - options.floor - options.floor_gap
        if height < gap[-1]:
            gap[-1] = height
            for k in range(3):
                contact[-1, 0, k] = points[v, k] if k < 2 else options.floor
                contact[-1, 1, k] = 0.0 if k < 2 else 1.0


@kernel
def smallest_distance(points: F64, particles: F64, x: F64, rot: F64) -> float:
    """Return the smallest distance in metres between points (V, 3) and a body's particles (P, 3).

    ``points`` are in the world, ``particles`` in the frame of the body with the pose ``x`` (3,),
    ``rot`` (3, 3).
    """
    smallest, local = np.inf, np.empty(3)
    for v in range(len(points)):
        to_local(points[v], x, rot, local)
        for p in range(len(particles)):
            dx = local[0] - particles[p, 0]
            dy = local[1] - particles[p, 1]
            dz = local[2] - particles[p, 2]
            smallest = min(smallest, dx * dx + dy * dy + dz * dz)
    return float(np.sqrt(smallest))


@kernel
def run_cloth(
    points: F64,
    velocities: F64,
    springs: Springs,
    scenery: MovingSolids,
    options: ClothOptions,
    record: ClothRecord,
) -> None:
    """Move one sheet through all frames.

    Parameters
    ----------
    points, velocities : (V, 3)
        State of the cloth in metres and m/s; changed.
    springs : Springs
        Of the sheet.
    scenery : MovingSolids
        Bodies, how they move, and the body whose distance is recorded.
    options : ClothOptions
        Numbers of the simulation.
    record : ClothRecord
        Is filled.
    """
    solids, positions, rotations = scenery.solids, scenery.positions, scenery.rotations
    watched = scenery.watched
    number, bodies = len(points), positions.shape[1]
    start = points.copy()
    corrections = Corrections(np.zeros((number, 3)), np.zeros(number))
    near = Neighbours(
        np.zeros(number, np.int64),
        np.zeros((number, MAX_NEIGHBOURS), np.int64),
        np.zeros((number, MAX_NEIGHBOURS, 3)),
        np.zeros((number, MAX_NEIGHBOURS, 3)),
    )
    poses = BodyPoses(np.zeros((bodies, 3)), np.zeros((bodies, 3, 3)))
    old = BodyPoses(np.zeros((bodies, 3)), np.zeros((bodies, 3, 3)))
    step = options.frame_time / options.substeps
    reach = options.rest_distance + options.search_margin
    for frame in range(len(positions)):
        interpolate_poses(positions, rotations, frame, 0.0 if frame > 0 else 1.0, old)
        for part in range(options.substeps if frame > 0 else 0):
            fraction = (part + 1) / options.substeps
            interpolate_poses(positions, rotations, frame, fraction, poses)
            start[:] = points
            for v in range(number):
                for k in range(3):
                    velocities[v, k] -= step * options.damping * velocities[v, k]
                velocities[v, 2] -= step * options.gravity
                for k in range(3):
                    points[v, k] += step * velocities[v, k]
            find_neighbours(points, reach, solids, poses, old, near)
            for _ in range(options.iterations):
                correct_contacts(points, start, near, options, corrections)
                correct_springs(points, springs, corrections)
                add_normal_corrections(
                    points,
                    near,
                    options,
                    corrections.constraint_count,
                    record.normal_correction[frame],
                )
                apply_average(points, corrections)
            for v in range(number):
                for k in range(3):
                    velocities[v, k] = (points[v, k] - start[v, k]) / step
            old.x[:] = poses.x
            old.rot[:] = poses.rot
        if frame == 0:
            poses.x[:] = old.x
            poses.rot[:] = old.rot
            find_neighbours(points, reach, solids, poses, old, near)
        record.vertices[frame] = points
        record_gaps(points, near, options, record.gap[frame], record.contact[frame])
        if watched >= 0:
            record.distance[frame] = smallest_distance(
                points, scenery.watched_particles, poses.x[watched], poses.rot[watched]
            )
