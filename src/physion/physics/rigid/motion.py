"""Motion between contacts: gravity, drag, the cap of the spin, and the step of the poses."""

from __future__ import annotations

import numpy as np

from physion.numerics.elementary import cos_of, sin_of
from physion.numerics.kernel import in_place_kernel
from physion.physics.rigid.solver import F64, Flags

MIN_SPIN = 1e-12
"""Radians per second: keeps the cap of the angular velocity from dividing by zero."""

# Free motion and integration: semi-implicit Euler, velocities first, then poses with the velocities
# at the end of the step. PhysX: `bodyCoreComputeUnconstrainedVelocity` and `integrateCore`.


@in_place_kernel
def move_freely(
    v: F64,
    w: F64,
    asleep: Flags,
    drag: F64,
    gravity: float,
    max_angular_velocity: float,
    dt: float,
) -> None:
    """Change velocities by a step of gravity and drag, and cap the angular velocity.

    Parameters
    ----------
    v, w : (B + 1, 3)
        Velocities in m/s and rad/s, world axes; changed, but for the last row and sleepers.
    asleep : (B,)
        Bodies that are not simulated.
    drag : (B, 2)
        Linear and angular drag c, d per second.
    gravity, max_angular_velocity, dt : float
        g in m/s^2 downwards, rad/s, seconds.

    Notes
    -----
    v <- (v - g dt z) max(1 - c dt, 0), w <- w max(1 - d dt, 0), then w <- w min(1, cap / |w|).
    """
    for i in range(len(asleep)):
        if asleep[i]:
            continue
        v[i, 2] -= gravity * dt
        keep_v, keep_w = max(1.0 - drag[i, 0] * dt, 0.0), max(1.0 - drag[i, 1] * dt, 0.0)
        for j in range(3):
            v[i, j] *= keep_v
            w[i, j] *= keep_w
        speed = np.sqrt(w[i, 0] * w[i, 0] + w[i, 1] * w[i, 1] + w[i, 2] * w[i, 2])
        factor = min(1.0, max_angular_velocity / max(speed, MIN_SPIN))
        for j in range(3):
            w[i, j] *= factor


@in_place_kernel
def move_pose(x: F64, q: F64, v: F64, w: F64, dt: float) -> None:
    """Move one body: ``x`` (3,), ``q`` (4,) by ``v``, ``w`` (3,), as in `move_poses`."""
    for j in range(3):
        x[j] += v[j] * dt
    speed = np.sqrt(w[0] ** 2 + w[1] ** 2 + w[2] ** 2)
    if speed == 0.0:
        return
    half = 0.5 * speed * dt
    c, s = cos_of(half), sin_of(half) / speed
    dx, dy, dz = w[0] * s, w[1] * s, w[2] * s
    qw, qx, qy, qz = q[0], q[1], q[2], q[3]
    q[0] = c * qw - dx * qx - dy * qy - dz * qz
    q[1] = c * qx + dx * qw + dy * qz - dz * qy
    q[2] = c * qy - dx * qz + dy * qw + dz * qx
    q[3] = c * qz + dx * qy - dy * qx + dz * qw
    length = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for j in range(4):
        q[j] /= length


@in_place_kernel
def move_poses(x: F64, q: F64, v: F64, w: F64, asleep: Flags, dt: float) -> None:
    """Move centres of mass ``x`` and orientations ``q`` by constant velocities over ``dt`` seconds.

    Parameters
    ----------
    x, q : (B + 1, 3), (B + 1, 4)
        Changed, but for the last row, which stands for the world.
    v, w : (B + 1, 3)
        Velocities in m/s and rad/s, world axes.
    asleep : (B,)
        Bodies that do not move.
    dt : float
        Seconds.

    Notes
    -----
    x <- x + v dt; q <- (cos(|w| dt / 2), sin(|w| dt / 2) w / |w|) q, then q <- q / |q|.
    """
    for i in range(len(x) - 1):
        if not asleep[i]:
            move_pose(x[i], q[i], v[i], w[i], dt)


@in_place_kernel
def fill_rotations(q: F64, rot: F64, start: int, stop: int) -> None:
    """Fill rows ``start`` to ``stop`` of ``rot`` (B, 3, 3) with the matrices of ``q`` (B, 4)."""
    for i in range(start, stop):
        w, x, y, z = q[i, 0], q[i, 1], q[i, 2], q[i, 3]
        rot[i, 0, 0] = 1 - 2 * (y * y + z * z)
        rot[i, 0, 1] = 2 * (x * y - w * z)
        rot[i, 0, 2] = 2 * (x * z + w * y)
        rot[i, 1, 0] = 2 * (x * y + w * z)
        rot[i, 1, 1] = 1 - 2 * (x * x + z * z)
        rot[i, 1, 2] = 2 * (y * z - w * x)
        rot[i, 2, 0] = 2 * (x * z - w * y)
        rot[i, 2, 1] = 2 * (y * z + w * x)
        rot[i, 2, 2] = 1 - 2 * (x * x + y * y)
