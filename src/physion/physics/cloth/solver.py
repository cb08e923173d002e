"""The inner loops of the cloth: position-based dynamics on particles, compiled by numba.

Everything runs in one fixed order on one core, without fastmath: equal input, equal bytes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel
from physion.numerics.rotations import rotation_matrix

Array = NDArray[Any]

MAX_NEIGHBOURS = 100
"""Most solid particles that one cloth particle minds at a time (the official container's limit)."""


class Springs(NamedTuple):
    """Pairs of particles that keep their distance.

    ``ends`` (S, 2) indices, ``lengths`` (S,) metres at rest, ``stiffness`` (S,) share of the error
    that one pass removes.
    """

    ends: Array
    lengths: Array
    stiffness: Array


class Solids(NamedTuple):
    """Particles that fill rigid bodies, each body's on a lattice in its own frame.

    ``origins`` (N, 3) metres of the lattices' first corners, ``sizes`` (N, 3) points a side,
    ``starts`` (N,) where a body's occupancy begins in ``filled`` (row-major), ``spacing`` metres.
    """

    origins: Array
    sizes: Array
    starts: Array
    filled: Array
    spacing: float


class Poses(NamedTuple):
    """Poses of all bodies: ``place`` (N, 3) metres and ``turn`` (N, 3, 3) rotation matrices."""

    place: Array
    turn: Array


class Near(NamedTuple):
    """The solid particles near each cloth particle, K at most.

    ``counts`` (V,) how many, ``owner`` (V, K) body, ``spot`` (V, K, 3) world position, ``moved``
    (V, K, 3) metres that the particle went during the step.
    """

    counts: Array
    owner: Array
    spot: Array
    moved: Array


class Rules(NamedTuple):
    """Numbers of the simulation in SI units; see `physion.physics.cloth.simulate.ClothSettings`."""

    frame_time: float
    substeps: int
    iterations: int
    rest: float
    margin: float
    ground: float
    floor_gap: float
    friction: float
    floor_friction: float
    damping: float
    gravity: float


class Record(NamedTuple):
    """What is written: one entry a frame, by body with the floor last where it says N + 1.

    ``vertices`` (F, V, 3); ``distance`` (F,) metres between particles of the cloth and of the
    watched body; ``gap`` (F, N + 1) smallest gap in metres; ``contact`` (F, N + 1, 2, 3) its point
    and the normal towards the cloth; ``pushed`` (F, N + 1) metres of correction, summed.
    """

    vertices: Array
    distance: Array
    gap: Array
    contact: Array
    pushed: Array


@kernel
def pose_between(positions: Array, rotations: Array, frame: int, share: float, out: Poses) -> None:
    """Fill ``out`` with the poses a ``share`` of the way from the frame before ``frame`` to it.

    ``positions`` (F, N, 3), ``rotations`` (F, N, 4).
    """
    mixed = np.empty(4)
    for body in range(positions.shape[1]):
        old, new = rotations[frame - 1, body], rotations[frame, body]
        dot = old[0] * new[0] + old[1] * new[1] + old[2] * new[2] + old[3] * new[3]
        sign = 1.0 if dot >= 0 else -1.0
        for k in range(4):
            mixed[k] = (1 - share) * old[k] + share * sign * new[k]
        length = np.sqrt(mixed[0] ** 2 + mixed[1] ** 2 + mixed[2] ** 2 + mixed[3] ** 2)
        for k in range(4):
            mixed[k] /= length
        out.turn[body] = rotation_matrix(mixed)
        for k in range(3):
            out.place[body, k] = (1 - share) * positions[frame - 1, body, k]
            out.place[body, k] += share * positions[frame, body, k]


@kernel
def to_local(point: Array, place: Array, turn: Array, out: Array) -> None:
    """Fill ``out`` (3,) with a world point as seen in the frame of a body."""
    for k in range(3):
        out[k] = 0.0
        for j in range(3):
            out[k] += turn[j, k] * (point[j] - place[j])


@kernel
def find_neighbours(
    points: Array, reach: float, solids: Solids, poses: Poses, old: Poses, near: Near
) -> None:
    """List for every point the solid particles within ``reach``; ``old`` poses began the step."""
    local, spot = np.empty(3), np.empty(3)
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    spacing, square = solids.spacing, reach * reach
    for v in range(len(points)):
        near.counts[v] = 0
        for body in range(len(solids.origins)):
            to_local(points[v], poses.place[body], poses.turn[body], local)
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
def _add_neighbour(v: int, body: int, spot: Array, poses: Poses, old: Poses, near: Near) -> None:
    found = near.counts[v]
    if found == near.owner.shape[1]:
        return
    near.counts[v] = found + 1
    near.owner[v, found] = body
    for m in range(3):
        now, then = poses.place[body, m], old.place[body, m]
        for n in range(3):
            now += poses.turn[body, m, n] * spot[n]
            then += old.turn[body, m, n] * spot[n]
        near.spot[v, found, m] = now
        near.moved[v, found, m] = now - then


@kernel
def push_out(
    points: Array,
    start: Array,
    near: Near,
    rules: Rules,
    shift: Array,
    shares: Array,
) -> None:
    """Add to ``shift`` (V, 3) what moves each point out of solids and floor, against its slip.

    ``start`` (V, 3) is where the points were before the step; ``shares`` (V,) counts the
    constraints.
    """
    for v in range(len(points)):
        for c in range(near.counts[v]):
            dx = points[v, 0] - near.spot[v, c, 0]
            dy = points[v, 1] - near.spot[v, c, 1]
            dz = points[v, 2] - near.spot[v, c, 2]
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            if distance >= rules.rest or distance < 1e-9:
                continue
            depth = rules.rest - distance
            dx, dy, dz = dx / distance, dy / distance, dz / distance
            ux = points[v, 0] - start[v, 0] - near.moved[v, c, 0]
            uy = points[v, 1] - start[v, 1] - near.moved[v, c, 1]
            uz = points[v, 2] - start[v, 2] - near.moved[v, c, 2]
            along = ux * dx + uy * dy + uz * dz
            ux, uy, uz = ux - along * dx, uy - along * dy, uz - along * dz
            slip = np.sqrt(ux * ux + uy * uy + uz * uz)
            hold = min(1.0, rules.friction * depth / slip) if slip > 1e-12 else 0.0
            shift[v, 0] += dx * depth - hold * ux
            shift[v, 1] += dy * depth - hold * uy
            shift[v, 2] += dz * depth - hold * uz
            shares[v] += 1
        depth = rules.ground + rules.floor_gap - points[v, 2]
        if depth > 0:
            ux, uy = points[v, 0] - start[v, 0], points[v, 1] - start[v, 1]
            slip = np.sqrt(ux * ux + uy * uy)
            hold = min(1.0, rules.floor_friction * depth / slip) if slip > 1e-12 else 0.0
            shift[v, 0] -= hold * ux
            shift[v, 1] -= hold * uy
            shift[v, 2] += depth
            shares[v] += 1


@kernel
def add_load(points: Array, near: Near, rules: Rules, shares: Array, pushed: Array) -> None:
    """Add to ``pushed`` (N + 1,) how far each body and, last, the floor are about to push points.

    To be called when ``shares`` (V,) counts all constraints, before they are applied.
    """
    for v in range(len(points)):
        for c in range(near.counts[v]):
            dx = points[v, 0] - near.spot[v, c, 0]
            dy = points[v, 1] - near.spot[v, c, 1]
            dz = points[v, 2] - near.spot[v, c, 2]
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            if 1e-9 < distance < rules.rest:
                pushed[near.owner[v, c]] += (rules.rest - distance) / shares[v]
        depth = rules.ground + rules.floor_gap - points[v, 2]
        if depth > 0:
            pushed[-1] += depth / shares[v]


@kernel
def pull_springs(points: Array, springs: Springs, shift: Array, shares: Array) -> None:
    """Add to ``shift`` what brings each spring back to its length, scaled by its stiffness."""
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
        shares[a] += 1
        shares[b] += 1


@kernel
def apply_average(points: Array, shift: Array, shares: Array) -> None:
    """Move every point by the mean of its corrections and clear them."""
    for v in range(len(points)):
        if shares[v] > 0:
            for k in range(3):
                points[v, k] += shift[v, k] / shares[v]
                shift[v, k] = 0.0
            shares[v] = 0.0


@kernel
def keep_closest(points: Array, near: Near, rules: Rules, gap: Array, contact: Array) -> None:
    """Note in ``gap`` (N + 1,) the smallest gap to each body and, last, to the floor, in metres.

    ``contact`` (N + 1, 2, 3) keeps the point on the cloth's underside and the normal towards it.
    """
    for v in range(len(points)):
        for c in range(near.counts[v]):
            dx = points[v, 0] - near.spot[v, c, 0]
            dy = points[v, 1] - near.spot[v, c, 1]
            dz = points[v, 2] - near.spot[v, c, 2]
            distance = np.sqrt(dx * dx + dy * dy + dz * dz)
            body = near.owner[v, c]
            if distance - rules.rest < gap[body] and distance > 1e-9:
                gap[body] = distance - rules.rest
                for k in range(3):
                    contact[body, 1, k] = (points[v, k] - near.spot[v, c, k]) / distance
                    contact[body, 0, k] = points[v, k] - rules.rest * contact[body, 1, k]
        height = points[v, 2] - rules.ground - rules.floor_gap
        if height < gap[-1]:
            gap[-1] = height
            for k in range(3):
                contact[-1, 0, k] = points[v, k] if k < 2 else rules.ground
                contact[-1, 1, k] = 0.0 if k < 2 else 1.0


@kernel
def smallest_distance(points: Array, particles: Array, place: Array, turn: Array) -> float:
    """Smallest distance in metres between ``points`` (V, 3) and the particles of one body.

    ``particles`` (P, 3) are in the body's frame; ``place`` (3,) and ``turn`` (3, 3) are its pose.
    """
    smallest, local = np.inf, np.empty(3)
    for v in range(len(points)):
        to_local(points[v], place, turn, local)
        for p in range(len(particles)):
            dx = local[0] - particles[p, 0]
            dy = local[1] - particles[p, 1]
            dz = local[2] - particles[p, 2]
            smallest = min(smallest, dx * dx + dy * dy + dz * dz)
    return float(np.sqrt(smallest))


@kernel
def run_cloth(
    points: Array,
    velocities: Array,
    springs: Springs,
    solids: Solids,
    positions: Array,
    rotations: Array,
    rules: Rules,
    watched: int,
    watched_particles: Array,
    record: Record,
) -> None:
    """Move one sheet, whose ``points`` and ``velocities`` (V, 3) are changed, through all frames.

    ``positions`` (F, N, 3) and ``rotations`` (F, N, 4) give the bodies' poses. Distances are to
    ``watched_particles`` (P, 3) of the body ``watched``; -1 means that none is watched.
    """
    number, bodies = len(points), positions.shape[1]
    shift, shares, start = np.zeros((number, 3)), np.zeros(number), points.copy()
    near = Near(
        np.zeros(number, np.int64),
        np.zeros((number, MAX_NEIGHBOURS), np.int64),
        np.zeros((number, MAX_NEIGHBOURS, 3)),
        np.zeros((number, MAX_NEIGHBOURS, 3)),
    )
    poses = Poses(np.zeros((bodies, 3)), np.zeros((bodies, 3, 3)))
    old = Poses(np.zeros((bodies, 3)), np.zeros((bodies, 3, 3)))
    step = rules.frame_time / rules.substeps
    reach = rules.rest + rules.margin
    for frame in range(len(positions)):
        pose_between(positions, rotations, frame, 0.0 if frame > 0 else 1.0, old)
        for part in range(rules.substeps if frame > 0 else 0):
            share = (part + 1) / rules.substeps
            pose_between(positions, rotations, frame, share, poses)
            start[:] = points
            for v in range(number):
                for k in range(3):
                    velocities[v, k] -= step * rules.damping * velocities[v, k]
                velocities[v, 2] -= step * rules.gravity
                for k in range(3):
                    points[v, k] += step * velocities[v, k]
            find_neighbours(points, reach, solids, poses, old, near)
            for _ in range(rules.iterations):
                push_out(points, start, near, rules, shift, shares)
                pull_springs(points, springs, shift, shares)
                add_load(points, near, rules, shares, record.pushed[frame])
                apply_average(points, shift, shares)
            for v in range(number):
                for k in range(3):
                    velocities[v, k] = (points[v, k] - start[v, k]) / step
            old.place[:] = poses.place
            old.turn[:] = poses.turn
        if frame == 0:
            poses.place[:] = old.place
            poses.turn[:] = old.turn
            find_neighbours(points, reach, solids, poses, old, near)
        record.vertices[frame] = points
        keep_closest(points, near, rules, record.gap[frame], record.contact[frame])
        if watched >= 0:
            record.distance[frame] = smallest_distance(
                points, watched_particles, poses.place[watched], poses.turn[watched]
            )
