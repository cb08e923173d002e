"""Rotations as unit quaternions (w, x, y, z) and as matrices.

A rotation takes vectors from the frame of a body to the world. Products apply the right factor
first.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.numerics.elementary import cos, sin
from physion.numerics.kernel import kernel
from physion.numerics.linear_algebra import cross, unit

F64 = NDArray[np.float64]


@kernel
def rotation_matrix(q: Any) -> Any:
    """Return the matrix (3, 3) of a unit quaternion (4,)."""
    w, x, y, z = float(q[0]), float(q[1]), float(q[2]), float(q[3])
    m = np.empty((3, 3))
    m[0, 0] = 1 - 2 * (y * y + z * z)
    m[0, 1] = 2 * (x * y - w * z)
    m[0, 2] = 2 * (x * z + w * y)
    m[1, 0] = 2 * (x * y + w * z)
    m[1, 1] = 1 - 2 * (x * x + z * z)
    m[1, 2] = 2 * (y * z - w * x)
    m[2, 0] = 2 * (x * z - w * y)
    m[2, 1] = 2 * (y * z + w * x)
    m[2, 2] = 1 - 2 * (x * x + y * y)
    return m


@kernel
def rotate_vector(q: Any, v: Any) -> Any:
    """Return a vector (3,) rotated by a unit quaternion (4,).

    v' = v + 2 w (u x v) + 2 u x (u x v) with u = (x, y, z).
    """
    w, x, y, z = q[0], q[1], q[2], q[3]
    a = 2.0 * (y * v[2] - z * v[1])
    b = 2.0 * (z * v[0] - x * v[2])
    c = 2.0 * (x * v[1] - y * v[0])
    out = np.empty(3)
    out[0] = v[0] + w * a + (y * c - z * b)
    out[1] = v[1] + w * b + (z * a - x * c)
    out[2] = v[2] + w * c + (x * b - y * a)
    return out


@kernel
def _fill_matrices(q: Any, out: Any) -> None:
    """Fill ``out`` (N, 3, 3) with the matrices of unit quaternions ``q`` (N, 4)."""
    for i in range(len(q)):
        out[i] = rotation_matrix(q[i])


def rotation_matrices(q: ArrayLike) -> F64:
    """Return the matrices (..., 3, 3) of unit quaternions (..., 4)."""
    rotations = np.asarray(q, np.float64)
    out = np.empty((rotations.size // 4, 3, 3))
    _fill_matrices(np.ascontiguousarray(rotations).reshape(-1, 4), out)
    return out.reshape(*rotations.shape[:-1], 3, 3)


def multiply_quaternions(a: ArrayLike, b: ArrayLike) -> F64:
    """Return Hamilton products (..., 4) of quaternions (..., 4), leading axes broadcast."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a, np.float64), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b, np.float64), -1, 0)
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def conjugate(q: ArrayLike) -> F64:
    """Return the inverse rotations (..., 4) of unit quaternions (..., 4)."""
    return np.asarray(np.asarray(q, np.float64) * np.array([1.0, -1.0, -1.0, -1.0]))


def rotate_vectors(q: ArrayLike, vectors: ArrayLike) -> F64:
    """Return vectors (..., 3) rotated by unit quaternions (..., 4), leading axes broadcast."""
    rotation, v = np.asarray(q, np.float64), np.asarray(vectors, np.float64)
    axis = rotation[..., 1:]
    twice = 2.0 * cross(axis, v)
    return np.asarray(v + rotation[..., :1] * twice + cross(axis, twice))


def axis_angle_quaternion(axis: ArrayLike, angle: float) -> F64:
    """Return the unit quaternion (4,) of a rotation by ``angle`` radians about ``axis`` (3,)."""
    return np.array([cos(0.5 * angle), *(sin(0.5 * angle) * unit(axis))])


def axis_angle_matrix(axis: ArrayLike, angle: float) -> F64:
    """Return the matrix (3, 3) of a rotation by ``angle`` radians about ``axis`` (3,)."""
    return rotation_matrices(axis_angle_quaternion(axis, angle))
