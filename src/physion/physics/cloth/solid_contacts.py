"""Contacts of solids filled with particles: corrections of particles, and the best fit to them.

Contacts correct the particles of each solid, every one by the mean of its corrections, and shape
matching then moves the solid as a whole to the place that fits the corrected particles best. For
small corrections dp of n particles at r from the centre, the best fit is the translation
sum(dp) / n and the rotation J^-1 sum(r x dp), where J is the sum of |r|^2 1 - r r^T (the inertia of
particles of mass 1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel
from physion.physics.cloth.contacts import MIN_DISTANCE, ClothOptions, friction_hold
from physion.physics.cloth.near_solids import BodyPoses, Neighbours, new_poses
from physion.physics.cloth.solid_motion import (
    SolidParticles,
    SolidState,
    place_bodies,
    rotate_by,
)

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


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
