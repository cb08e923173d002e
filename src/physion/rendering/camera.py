"""Pinhole camera: its matrices, and conversion between world points and pixels.

Camera axes are x right, y down, z forward (along the optical axis). Pixel coordinates are
continuous: the picture spans 0..width and 0..height, and the centre of the pixel in column ``j``
and row ``i`` is ``(j + 0.5, i + 0.5)``. Depth is planar: metres along the optical axis, not along
the ray.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.core.errors import BadInputError
from physion.numerics.elementary import tan
from physion.numerics.linear_algebra import apply, multiply, norm, unit
from physion.scenes.scene import Camera

F64 = NDArray[np.float64]


def axes(camera: Camera) -> F64:
    """Return the camera's right, down and forward axes in the world as rows (3, 3).

    They are orthonormal, with the world's z upright in the picture. For a camera that looks
    straight up or down, +y is upright.
    """
    forward = np.subtract(camera.target, camera.position).astype(np.float64)
    length = float(norm(forward))
    if length == 0.0:
        raise BadInputError("the camera's position and target are the same point; move one of them")
    forward /= length
    right = np.cross(forward, (0.0, 0.0, 1.0))
    if norm(right) < 1e-9:
        right = np.cross(forward, (0.0, 1.0, 0.0))
    right = unit(right)
    return np.stack([right, np.cross(forward, right), forward])


def view_matrix(camera: Camera) -> F64:
    """Return the matrix (4, 4) from world (x, y, z, 1) to camera coordinates."""
    matrix = np.eye(4)
    matrix[:3, :3] = axes(camera)
    matrix[:3, 3] = apply(-matrix[:3, :3], camera.position)
    return matrix


def intrinsics(camera: Camera, width: int, height: int) -> F64:
    """Return the matrix (3, 3) from camera coordinates to homogeneous pixels (x w, y w, w).

    w is the depth. The focal length in pixels is height / (2 tan(fov / 2)); ``width`` and
    ``height`` are in pixels.
    """
    focal = 0.5 * height / tan(0.5 * camera.fov)
    return np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])


def projection_matrix(camera: Camera, width: int, height: int) -> F64:
    """Return the matrix (4, 4) from camera coordinates to the clip space of OpenGL.

    There x is right, y up, and z in -w..w. Other programs need it; the rasteriser uses
    `intrinsics`.
    """
    scale = 1.0 / tan(0.5 * camera.fov)
    near, far = camera.near, camera.far
    return np.array(
        [
            [scale * height / width, 0.0, 0.0, 0.0],
            [0.0, -scale, 0.0, 0.0],
            [0.0, 0.0, (far + near) / (far - near), -2.0 * far * near / (far - near)],
            [0.0, 0.0, 1.0, 0.0],
        ]
    )


@dataclass(frozen=True)
class View:
    """Camera together with the size of its picture in pixels."""

    camera: Camera
    width: int
    height: int

    @property
    def to_pixels(self) -> F64:
        """Matrix (3, 4) from world (x, y, z, 1) to homogeneous pixels (x w, y w, w).

        w is the depth in metres.
        """
        camera = self.camera
        return multiply(intrinsics(camera, self.width, self.height), view_matrix(camera)[:3])

    def project(self, points: ArrayLike) -> tuple[F64, F64]:
        """Return pixel coordinates (..., 2) and depths (...) in metres of world points (..., 3).

        Points behind the camera have a negative depth; their pixel coordinates have no meaning.
        """
        world = np.asarray(points, np.float64)
        matrix = self.to_pixels
        homogeneous = apply(matrix[:, :3], world) + matrix[:, 3]
        depth = homogeneous[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            return homogeneous[..., :2] / depth[..., None], depth

    @property
    def ray_matrix(self) -> F64:
        """Matrix (3, 3) from a pixel (x, y, 1) to the world vector from the camera to depth 1."""
        matrix = intrinsics(self.camera, self.width, self.height)
        focal, x, y = matrix[0, 0], matrix[0, 2], matrix[1, 2]
        pixel_to_camera = [[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, focal]]
        return multiply(axes(self.camera).T, np.array(pixel_to_camera) / focal)
