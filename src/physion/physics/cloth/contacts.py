"""Contact and friction of cloth particles with solid particles and the floor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel
from physion.physics.cloth.near_solids import Neighbours, to_local
from physion.physics.cloth.springs import MIN_LENGTH

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

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
