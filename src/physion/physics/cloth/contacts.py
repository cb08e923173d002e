"""Contact of cloth particles with the floor and with the particles of bodies.

Poses of the bodies between two frames, the search for particles nearby (`find_neighbours`), the
correction of positions with friction (`correct_contacts`), and the gaps that are left.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel
from physion.numerics.rotations import rotation_matrix
from physion.physics.cloth.springs import MIN_LENGTH

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


# Solid particles near points: records of bodies filled with particles, their poses, the search.

MAX_NEIGHBOURS = 100
"""Most solid particles in contact with one cloth particle (limit of the official container);
further ones are ignored."""
ROUNDING = 1e-9
"""Metres added to the box of a search, so that rounding excludes no particle."""
SLACK = 0.02
"""Metres that a cloth particle moves against a body before the lattice is scanned for it again.
Time and memory depend on it, results do not."""


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

    They are searched within ``reach`` metres. Candidates are those within ``reach + slack`` metres
    of ``scanned_at`` (V, N, 3), a point in the frame of each of N bodies, infinite before the first
    scan: ``candidate_counts`` (V, N) how many, and ``candidates`` (V, N, C, 3) their indices in the
    lattice, in its order. With a slack of 0 nothing is kept, and V of these three is 1.
    """

    counts: I64
    body: I64
    position: F64
    displacement: F64
    searched_at: F64
    reach: float
    slack: float
    scanned_at: F64
    candidate_counts: I64
    candidates: NDArray[np.int16]


@kernel
def new_poses(bodies: int) -> BodyPoses:
    """Return room for the poses of ``bodies`` bodies."""
    return BodyPoses(np.zeros((bodies, 3)), np.zeros((bodies, 3, 3)))


@kernel
def new_neighbours(
    particles: int, room: int, solids: Solids, reach: float, slack: float
) -> Neighbours:
    """Return room for the neighbours of ``particles`` particles among ``solids``.

    Each has ``room`` neighbours at most, within ``reach`` metres; for ``slack`` see `Neighbours`.
    """
    # A ball holds at most as many points of a cubic lattice as cubes fit in a ball whose radius is
    # larger by half the diagonal of a cube.
    bodies, radius = len(solids.origins), (reach + slack) / solids.spacing + 0.87
    most = min(int(4.19 * radius * radius * radius) + 1, len(solids.filled))
    kept = particles if slack > 0 else 1
    return Neighbours(
        np.zeros(particles, np.int64),
        np.empty((particles, room), np.int64),
        np.empty((particles, room, 3)),
        np.empty((particles, room, 3)),
        np.full((3, particles), np.inf),
        reach,
        slack,
        np.full((kept, bodies, 3), np.inf),
        np.zeros((kept, bodies), np.int64),
        np.empty((kept, bodies, most, 3), np.int16),
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
# substep at the predicted positions, with a hash grid. Here the lattice is scanned with some slack,
# and candidates are kept until the particle has moved that far against the body; what is within
# reach of it is found among them. Neighbours are kept while the particle is within half of the
# margin of where it was searched and no body moves.


@kernel
def find_neighbours(
    points: F64,
    keep: float,
    solids: Solids,
    poses: BodyPoses,
    old: BodyPoses,
    bounds: tuple[F64, F64],
    near: Neighbours,
) -> None:
    """Fill ``near`` with the solid particles within its reach of every cloth particle.

    Parameters
    ----------
    points : (3, V)
        Cloth particles, metres, world.
    keep : float
        Metres that a particle may have moved since its last search; below 0 all are searched.
    solids, poses, old
        Solid particles; poses of the bodies at the end and at the start of the substep.
    bounds : (N, 3), (N, 3)
        Of `world_bounds`.
    near : Neighbours
        Of `new_neighbours` for these solids; is filled up to its room, in the order of bodies.
    """
    # Records are taken apart here, and nothing is called or allocated for a particle: either would
    # cost more than the search.
    box_low, box_high = bounds
    origins, sizes, starts, filled, spacing = solids
    x, rot = poses
    old_x, old_rot = old
    counts, of_body, position, displacement, searched_at = near[:5]
    reach, slack, scanned_at, candidate_counts, candidates = near[5:]
    point, local, outside = np.empty(3), np.empty(3), np.empty(3)
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    square, wide, still = reach * reach, (reach + slack) ** 2, (slack - ROUNDING) ** 2
    for v in range(points.shape[1]):
        moved = 0.0
        for k in range(3):
            point[k] = points[k, v]
            moved += (point[k] - searched_at[k, v]) ** 2
        if keep >= 0 and moved <= keep * keep:
            continue
        for k in range(3):
            searched_at[k, v] = point[k]
        found, row_kept = 0, v if slack > 0 else 0
        for body in range(len(origins)):
            apart = False
            for k in range(3):
                apart = apart or point[k] < box_low[body, k] or point[k] > box_high[body, k]
            if apart:
                continue
            total, drift = 0.0, 0.0
            for k in range(3):
                local[k] = -origins[body, k]
                for m in range(3):
                    local[k] += rot[body, m, k] * (point[m] - x[body, m])
                end = (sizes[body, k] - 1) * spacing
                outside[k] = max(-local[k], 0.0, local[k] - end) ** 2
                total += outside[k]
                drift += (local[k] - scanned_at[row_kept, body, k]) ** 2
            if total >= square:
                continue
            if slack == 0 or not drift <= still:
                listed = 0
                for k in range(3):
                    scanned_at[row_kept, body, k] = local[k]
                    # What the point is outside the lattice along the other axes leaves less along
                    # this.
                    left = np.sqrt(wide - (total - outside[k])) + ROUNDING
                    low[k] = max(int(np.ceil((local[k] - left) / spacing)), 0)
                    high[k] = min(int(np.floor((local[k] + left) / spacing)), sizes[body, k] - 1)
                for i in range(low[0], high[0] + 1):
                    dx = local[0] - i * spacing
                    for j in range(low[1], high[1] + 1):
                        dy = local[1] - j * spacing
                        flat = dx * dx + dy * dy
                        if flat + outside[2] >= wide:
                            continue
                        row = starts[body] + (i * sizes[body, 1] + j) * sizes[body, 2]
                        for k in range(low[2], high[2] + 1):
                            dz = local[2] - k * spacing
                            if filled[row + k] and flat + dz * dz < wide:
                                candidates[row_kept, body, listed, 0] = i
                                candidates[row_kept, body, listed, 1] = j
                                candidates[row_kept, body, listed, 2] = k
                                listed += 1
                candidate_counts[row_kept, body] = listed
            for c in range(candidate_counts[row_kept, body]):
                i, j = candidates[row_kept, body, c, 0], candidates[row_kept, body, c, 1]
                k = candidates[row_kept, body, c, 2]
                dx, dy, dz = local[0] - i * spacing, local[1] - j * spacing, local[2] - k * spacing
                if not dx * dx + dy * dy + dz * dz < square or found == of_body.shape[1]:
                    continue
                sx = origins[body, 0] + i * spacing
                sy = origins[body, 1] + j * spacing
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


MIN_DISTANCE = 1e-9
"""Metres between a cloth particle and a solid one below which a contact has no direction."""


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


# For a cloth particle p and a solid particle s, with r = |p - s|, rest distance r0 and
# n = (p - s) / r, the constraint is C = r - r0 >= 0. Where it is violated by the depth d = -C, the
# particle alone moves, since bodies do not give way:
#     dp = d n - min(1, mu d / |u|) u,
# where u is the tangential part of its slip against s in this substep, (p - x) - (s - s_old). The
# second term is Coulomb friction on positions: it takes back all of a slip shorter than mu d and mu
# d of a longer one (the friction model of Macklin et al. 2014, with one coefficient for rest and
# sliding). The floor is a plane with C = p_z - (floor + gap).
#
# Contact impulse: a correction by dp within a substep h is a change of velocity by dp / h. The sum
# over all passes of d / (number of constraints) is what contacts moved the particles of a cloth.


@kernel
def correct_contacts(
    points: F64,
    start: F64,
    touching: I64,
    near: Neighbours,
    options: ClothOptions,
    shift: F64,
    constraint_count: F64,
    normal_correction: F64,
) -> None:
    """Add the corrections that move particles out of solids and the floor, against their slip.

    Parameters
    ----------
    points, start : (3, V)
        Positions now, and before the substep; metres.
    touching : (T,)
        Particles that may touch something.
    near, options
        Solid particles that may touch; distances and friction.
    shift : (3, V)
        Sums of corrections, metres; is added to.
    constraint_count : (V,)
        Number of constraints of each particle, springs included; is added to.
    normal_correction : (N + 1,)
        Metres by which contacts move particles along their normals, by body and, last, for the
        floor; is added to.
    """
    rest_distance, rest_square = options.rest_distance, options.rest_distance**2
    run_body = np.empty(len(normal_correction) + 1, np.int64)
    run_depth = np.empty(len(normal_correction) + 1)
    for v in touching:
        px, py, pz = points[0, v], points[1, v], points[2, v]
        mx, my, mz = px - start[0, v], py - start[1, v], pz - start[2, v]
        sx = sy = sz = 0.0
        contacts, runs = 0, 0
        for c in range(near.counts[v]):
            dx = px - near.position[v, c, 0]
            dy = py - near.position[v, c, 1]
            dz = pz - near.position[v, c, 2]
            square = dx * dx + dy * dy + dz * dz
            if square >= rest_square:
                continue
            distance = np.sqrt(square)
            if distance < MIN_DISTANCE:
                continue
            depth = rest_distance - distance
            dx, dy, dz = dx / distance, dy / distance, dz / distance
            ux = mx - near.displacement[v, c, 0]
            uy = my - near.displacement[v, c, 1]
            uz = mz - near.displacement[v, c, 2]
            along = ux * dx + uy * dy + uz * dz
            ux, uy, uz = ux - along * dx, uy - along * dy, uz - along * dz
            hold = friction_hold(ux * ux + uy * uy + uz * uz, options.friction * depth)
            sx += dx * depth - hold * ux
            sy += dy * depth - hold * uy
            sz += dz * depth - hold * uz
            contacts += 1
            body = near.body[v, c]
            if runs == 0 or run_body[runs - 1] != body:
                run_body[runs], run_depth[runs] = body, 0.0
                runs += 1
            run_depth[runs - 1] += depth
        depth = options.floor + options.floor_gap - pz
        if depth > 0:
            hold = friction_hold(mx * mx + my * my, options.floor_friction * depth)
            sx -= hold * mx
            sy -= hold * my
            sz += depth
            contacts += 1
            run_body[runs], run_depth[runs] = len(normal_correction) - 1, depth
            runs += 1
        if contacts:
            shift[0, v] += sx
            shift[1, v] += sy
            shift[2, v] += sz
            constraint_count[v] += contacts
            for run in range(runs):
                normal_correction[run_body[run]] += run_depth[run] / constraint_count[v]


@kernel
def friction_hold(slip_square: float, most: float) -> float:
    """Return which fraction of a slip friction takes back, at most ``most`` metres of it."""
    if slip_square <= most * most:
        return 1.0
    slip = np.sqrt(slip_square)
    return float(most / slip) if slip > MIN_LENGTH else 0.0


@kernel
def record_gaps(
    points: F64, near: Neighbours, options: ClothOptions, gap: F64, contact: F64
) -> None:
    """Lower ``gap`` to the smallest gap between the cloth and each body and, last, the floor.

    Parameters
    ----------
    points : (3, V)
        Positions, metres.
    near, options
        As in `correct_contacts`.
    gap : (N + 1,)
        Metres; a gap is the distance of particles less the rest distance.
    contact : (N + 1, 2, 3)
        Gets the point on the cloth's underside, and the normal towards the cloth.
    """
    rest_distance = options.rest_distance
    for v in range(points.shape[1]):
        for c in range(near.counts[v]):
            dx = points[0, v] - near.position[v, c, 0]
            dy = points[1, v] - near.position[v, c, 1]
            dz = points[2, v] - near.position[v, c, 2]
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            body = near.body[v, c]
            if distance - rest_distance < gap[body] and distance > MIN_DISTANCE:
                gap[body] = distance - rest_distance
                for k in range(3):
                    contact[body, 1, k] = (points[k, v] - near.position[v, c, k]) / distance
                    contact[body, 0, k] = points[k, v] - rest_distance * contact[body, 1, k]
        height = points[2, v] - options.floor - options.floor_gap
        if height < gap[-1]:
            gap[-1] = height
            for k in range(3):
                contact[-1, 0, k] = points[k, v] if k < 2 else options.floor
                contact[-1, 1, k] = 0.0 if k < 2 else 1.0


@kernel
def smallest_distance(points: F64, particles: F64, x: F64, rot: F64) -> float:
    """Return the smallest distance in metres between points (3, V) and a body's particles (P, 3).

    ``points`` are in the world, ``particles`` in the frame of the body with the pose ``x`` (3,),
    ``rot`` (3, 3). A point whose distance to the box of the particles is no smaller than what was
    found already is passed over.
    """
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for p in range(len(particles)):
        for k in range(3):
            low[k], high[k] = min(low[k], particles[p, k]), max(high[k], particles[p, k])
    count = points.shape[1]
    local, point, to_box = np.empty((count, 3)), np.empty(3), np.empty(count)
    first = 0
    for v in range(count):
        for k in range(3):
            point[k] = points[k, v]
        to_local(point, x, rot, local[v])
        to_box[v] = 0.0
        for k in range(3):
            to_box[v] += max(low[k] - local[v, k], 0.0, local[v, k] - high[k]) ** 2
        first = v if to_box[v] < to_box[first] else first
    smallest = np.inf
    for number in range(-1, count):
        v = first if number < 0 else number
        if to_box[v] >= smallest:
            continue
        for p in range(len(particles)):
            dx = local[v, 0] - particles[p, 0]
            dy = local[v, 1] - particles[p, 1]
            dz = local[v, 2] - particles[p, 2]
            smallest = min(smallest, dx * dx + dy * dy + dz * dz)
    return float(np.sqrt(smallest))
