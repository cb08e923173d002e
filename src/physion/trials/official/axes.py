"""Between our axes and the official ones, for whole arrays, in both directions.

Ours: z up, right-handed, quaternions (w, x, y, z). Official (Unity): y up, left-handed, quaternions
(x, y, z, w). A point (x, y, z) of ours is (x, z, y) there. Swapping two axes mirrors space, so that
directions of turning flip as well: that is the only difference between points and turns. Arrays
may have any leading axes (docs/official-system.md, section 1).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.errors import BadInputError
from physion.rendering.camera import projection_matrix, view_matrix
from physion.scenes.scene import Camera

Floats = NDArray[np.float64]

SWAP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
"""Takes a point from either system to the other, (3, 3)."""
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Our camera axes (right, down, forward) as Unity's matrices have them (right, up, backward)."""
_UPRIGHT = 1e-3
"""Largest tilt of a camera's right axis out of the horizontal that is taken for rounding."""


def swap_axes(points: ArrayLike) -> Floats:
    """Points, directions or velocities (..., 3) in the other system; its own inverse."""
    return np.asarray(points, np.float64)[..., [0, 2, 1]]


def swap_spin(spins: ArrayLike) -> Floats:
    """Angular velocities (..., 3) in the other system; its own inverse."""
    return np.negative(swap_axes(spins))


def to_official_rotation(rotations: ArrayLike) -> Floats:
    """Our quaternions (..., 4), (w, x, y, z), as official ones, (x, y, z, w)."""
    q = np.asarray(rotations, np.float64)
    return np.stack([-q[..., 1], -q[..., 3], -q[..., 2], q[..., 0]], axis=-1)


def from_official_rotation(rotations: ArrayLike) -> Floats:
    """Official quaternions (..., 4), (x, y, z, w), as ours, (w, x, y, z)."""
    q = np.asarray(rotations, np.float64)
    return np.stack([q[..., 3], -q[..., 0], -q[..., 2], -q[..., 1]], axis=-1)


def rotation_matrices(rotations: ArrayLike) -> Floats:
    """Matrices (..., 3, 3) of our quaternions (..., 4), which need not be of unit length."""
    q = np.asarray(rotations, np.float64)
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def to_official_euler(rotations: ArrayLike) -> Floats:
    """Unity's Euler angles (..., 3) in degrees, about x, y, z, of our quaternions (..., 4).

    They are applied in the order z, x, y. Looking straight up or down, z is 0.
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
    """``camera_matrix`` and ``projection_matrix`` (4, 4) as the official files have them.

    The first takes official world points to camera axes x right, y up, z backward (its rotation
    has determinant -1, as the real files have); the second those to OpenGL clip space.
    """
    swap = np.eye(4)
    swap[:3, :3] = SWAP
    world_to_camera = _OPENGL @ view_matrix(camera) @ swap
    return world_to_camera, projection_matrix(camera, width, height) @ _OPENGL


def from_official_camera(
    world_to_camera: Floats, projection: Floats, look_at: ArrayLike
) -> tuple[Camera, bool]:
    """Our camera of the official matrices (4, 4), and whether it stood upright in truth.

    ``look_at`` (3,), ours, decides how far along the view axis `Camera.target` lies, which changes
    no picture. A tilted camera is set upright. `BadInputError` for matrices that are no camera's.
    """
    turn = world_to_camera[:3, :3]
    if not np.isfinite(world_to_camera).all() or not np.allclose(turn @ turn.T, np.eye(3), 0, 1e-3):
        raise BadInputError("the camera matrix is no rotation and shift")
    scale, a, b = projection[1, 1], projection[2, 2], projection[2, 3]
    if not np.isfinite(projection).all() or scale <= 0 or a in (1.0, -1.0):
        raise BadInputError("the projection matrix is none of a perspective camera")
    eye = swap_axes(-turn.T @ world_to_camera[:3, 3])
    forward, right = swap_axes(-turn[2]), swap_axes(turn[0])
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
        raise BadInputError(f"the camera sees from {camera.near} to {camera.far} m")
    return camera, abs(float(right[2])) < _UPRIGHT
