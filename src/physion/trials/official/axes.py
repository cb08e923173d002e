"""Conversion of arrays between the axes of this package and those of the official files.

This package: z up, right-handed, quaternions (w, x, y, z). Official files (Unity): y up,
left-handed, quaternions (x, y, z, w). A point (x, y, z) here is (x, z, y) there. Swapping two axes
is a reflection, so the sign of rotations and angular velocities changes as well. Arrays may have
any leading axes (docs/official-system.md, section 1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.errors import BadInputError
from physion.rendering.camera import projection_matrix, view_matrix
from physion.scenes.scene import Camera

Floats = NDArray[np.float64]

SWAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
"""Matrix (3, 3) that converts a point from either system to the other."""
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Matrix from camera axes here (right, down, forward) to those of Unity (right, up, backward)."""
_UPRIGHT = 1e-3
"""Largest vertical component of a camera's right axis that counts as a rounding error."""


def swap_axes(points: ArrayLike) -> Floats:
    """Convert points, directions or velocities (..., 3) to the other system; its own inverse."""
    return np.asarray(points, np.float64)[..., [0, 2, 1]]


def swap_angular_velocity(angular_velocities: ArrayLike) -> Floats:
    """Convert angular velocities (..., 3) to the other system; its own inverse."""
    return np.negative(swap_axes(angular_velocities))


def to_official_rotation(rotations: ArrayLike) -> Floats:
    """Convert quaternions (..., 4) from (w, x, y, z) here to official (x, y, z, w)."""
    q = np.asarray(rotations, np.float64)
    return np.stack([-q[..., 1], -q[..., 3], -q[..., 2], q[..., 0]], axis=-1)


def from_official_rotation(rotations: ArrayLike) -> Floats:
    """Convert official quaternions (..., 4), (x, y, z, w), to (w, x, y, z) here."""
    q = np.asarray(rotations, np.float64)
    return np.stack([q[..., 3], -q[..., 0], -q[..., 2], -q[..., 1]], axis=-1)


def rotation_matrices(rotations: ArrayLike) -> Floats:
    """Return rotation matrices (..., 3, 3) of quaternions (..., 4), which are normalised first."""
    q = np.asarray(rotations, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def to_official_euler(rotations: ArrayLike) -> Floats:
    """Convert quaternions (..., 4) to Unity's Euler angles (..., 3) in degrees, about x, y, z.

    They are applied in the order z, x, y. In gimbal lock (x is 90 or -90 degrees), z is 0.
    """
    m = SWAP @ rotation_matrices(rotations) @ SWAP
    x = np.arcsin(np.clip(-m[..., 1, 2], -1.0, 1.0))
    level = np.abs(m[..., 1, 2]) < 1.0 - 1e-9
    y = np.where(
        level,
        np.arctan2(m[..., 0, 2], m[..., 2, 2]),
        np.arctan2(-m[..., 2, 0], m[..., 0, 0]),
    )
    z = np.where(level, np.arctan2(m[..., 1, 0], m[..., 1, 1]), 0.0)
    return np.asarray(np.degrees(np.stack([x, y, z], axis=-1)) + 0.0)


def to_official_camera(camera: Camera, width: int, height: int) -> tuple[Floats, Floats]:
    """Return ``camera_matrix`` and ``projection_matrix`` (4, 4) of the official files.

    The first maps official world points to camera axes x right, y up, z backward (the determinant
    of its rotation is -1, as in the official files), the second maps these to OpenGL clip space.
    """
    swap = np.eye(4)
    swap[:3, :3] = SWAP
    world_to_camera = _OPENGL @ view_matrix(camera) @ swap
    return world_to_camera, projection_matrix(camera, width, height) @ _OPENGL


def from_official_camera(
    world_to_camera: Floats, projection: Floats, look_at: ArrayLike
) -> tuple[Camera, bool]:
    """Convert official camera matrices to a camera, and return whether it was upright.

    Parameters
    ----------
    world_to_camera, projection
        Official matrices (4, 4).
    look_at
        Point (3,) in axes of this package near which `Camera.target` is put, on the view axis;
        it does not change the picture.

    Returns
    -------
    camera, upright
        The camera, without roll, and False if the official one had roll.

    Raises
    ------
    BadInputError
        If the matrices are not those of a perspective camera.
    """
    rotation = world_to_camera[:3, :3]
    if not np.isfinite(world_to_camera).all() or not np.allclose(
        rotation @ rotation.T, np.eye(3), 0, 1e-3
    ):
        raise BadInputError("the camera matrix is not a rotation with a translation")
    scale, a, b = projection[1, 1], projection[2, 2], projection[2, 3]
    if not np.isfinite(projection).all() or scale <= 0 or a in (1.0, -1.0):
        raise BadInputError("the projection matrix is not that of a perspective camera")
    eye = swap_axes(-rotation.T @ world_to_camera[:3, 3])
    forward, right = swap_axes(-rotation[2]), swap_axes(rotation[0])
    distance = max(float((np.asarray(look_at) - eye) @ forward), 0.1)
    target = eye + distance * forward
    camera = Camera(
        position=(float(eye[0]), float(eye[1]), float(eye[2])),
        target=(float(target[0]), float(target[1]), float(target[2])),
        fov=float(2 * np.arctan(1 / scale)),
        near=round(float(b / (a - 1)), 4),
        far=round(float(b / (a + 1)), 1),
    )
    if not 0 < camera.near < camera.far:
        raise BadInputError(
            f"the clipping planes of the camera are at {camera.near} and {camera.far} m"
        )
    return camera, abs(float(right[2])) < _UPRIGHT
