"""Solids filled with particles that move as a whole: records, particles, poses and rotations."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import dot, inverse, ordered_mean, ordered_sum
from physion.numerics.rotations import rotation_matrix
from physion.physics.cloth.near_solids import BodyPoses
from physion.physics.cloth.solids import fill_shape
from physion.scenes.scene import Quat, Vec3

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]


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
