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
from physion.numerics.elementary import arccos, cos, tan
from physion.numerics.linear_algebra import apply, dot, multiply, norm, unit
from physion.scenes.scene import Camera

Floats = NDArray[np.float64]


def axes(camera: Camera) -> Floats:
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


def view_matrix(camera: Camera) -> Floats:
    """Return the matrix (4, 4) from world (x, y, z, 1) to camera coordinates."""
    matrix = np.eye(4)
    matrix[:3, :3] = axes(camera)
    matrix[:3, 3] = apply(-matrix[:3, :3], camera.position)
    return matrix


def intrinsics(camera: Camera, width: int, height: int) -> Floats:
    """Return the matrix (3, 3) from camera coordinates to homogeneous pixels (x w, y w, w).

    w is the depth. The focal length in pixels is height / (2 tan(fov / 2)); ``width`` and
    ``height`` are in pixels.
    """
    focal = 0.5 * height / tan(0.5 * camera.fov)
    return np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])


def projection_matrix(camera: Camera, width: int, height: int) -> Floats:
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
    def to_pixels(self) -> Floats:
        """Matrix (3, 4) from world (x, y, z, 1) to homogeneous pixels (x w, y w, w).

        w is the depth in metres.
        """
        camera = self.camera
        return multiply(intrinsics(camera, self.width, self.height), view_matrix(camera)[:3])

    def project(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """Return pixel coordinates (..., 2) and depths (...) in metres of world points (..., 3).

        Points behind the camera have a negative depth; their pixel coordinates have no meaning.
        """
        world = np.asarray(points, np.float64)
        matrix = self.to_pixels
        homogeneous = apply(matrix[:, :3], world) + matrix[:, 3]
        depth = homogeneous[..., 2]
        with np.errstate(divide="ignore", invalid="ignore"):
            return homogeneous[..., :2] / depth[..., None], depth

    def unproject(self, pixels: ArrayLike, depth: ArrayLike) -> Floats:
        """Return world points (..., 3) at pixel coordinates (..., 2) and planar depths (...)."""
        xy = np.asarray(pixels, np.float64)
        rays = apply(self.ray_matrix, np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1))
        return np.asarray(np.asarray(self.camera.position) + rays * np.asarray(depth)[..., None])

    @property
    def ray_matrix(self) -> Floats:
        """Matrix (3, 3) from a pixel (x, y, 1) to the world vector from the camera to depth 1."""
        matrix = intrinsics(self.camera, self.width, self.height)
        focal, x, y = matrix[0, 0], matrix[0, 2], matrix[1, 2]
        pixel_to_camera = [[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, focal]]
        return multiply(axes(self.camera).T, np.array(pixel_to_camera) / focal)


# Meshes ready to be drawn: corner normals, texture coordinates, smooth surfaces.

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

FLAT = np.radians(1.0)
"""Angle in radians below which triangles that meet at an edge lie in one flat face."""
UV_MARGIN = 0.002
"""Distance in texture coordinates that a bounding box keeps from the seam of its texture."""
UV_SPAN = 0.996
"""Part of the texture that it therefore spans: 1 - 2 `UV_MARGIN`."""


@dataclass(frozen=True)
class MeshPart:
    """One mesh in the axes of its body. V vertices, T triangles.

    - ``vertices`` (V, 3): metres. ``faces`` (T, 3): counter-clockwise seen from outside.
    - ``normals`` (T, 3, 3): unit normal of each corner.
    - ``uv`` (T, 3, 2): texture coordinates of each corner; the texture repeats every unit.
    - ``tangents`` (T, 2, 3): world directions of growing u and v; zero without a normal map.
    - ``groups`` (T,): triangles of one number make one smooth surface, so that a pixel that shows
      several of them is shaded once.
    - ``materials`` (T,): index of the material.
    - ``two_sided``: whether the back of the triangles is drawn too.
    """

    vertices: F64
    faces: I32
    normals: F32
    uv: F32
    tangents: F32
    groups: I32
    materials: I32
    two_sided: bool = False


def face_normals(vertices: F64, faces: I32) -> F64:
    """Return the unit normals (T, 3); zero for a triangle without area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    length = norm(cross)[:, None]
    return np.asarray(np.divide(cross, length, out=np.zeros_like(cross), where=length > 0))


def solid(vertices: F64, faces: I32, scale: F64, crease: float, material: int) -> MeshPart:
    """Return the mesh of a body in metres.

    Parameters
    ----------
    vertices, faces
        (V, 3) at unit scale and (T, 3).
    scale
        (3,) factors along the axes of the body.
    crease
        Angle in radians, at unit scale, below which triangles that meet at an edge form one smooth
        surface.
    material
        Index of the material of all triangles.

    Notes
    -----
    The normal of a corner is the mean of the normals of the triangles of its surface that meet
    there, weighted by their angles (Thurmer and Wuthrich 1998). Texture coordinates are taken
    before scaling, from the side of the unit box that a triangle faces. A texture therefore
    stretches with its body, as in the original stimuli.

    References
    ----------
    Thurmer, G. and Wuthrich, C. (1998). Computing vertex normals from polygonal facets. Journal of
        Graphics Tools 3(1).
    """
    unit, faces = _merge(np.asarray(vertices, np.float64), np.asarray(faces, np.int32))
    scaled = unit * scale
    groups = _smooth_groups(faces, face_normals(unit, faces), cos(max(crease, FLAT)))
    normals = face_normals(scaled, faces)
    key = faces.astype(np.int64) + len(unit) * groups[:, None].astype(np.int64)
    _, corner_index = np.unique(key.ravel(), return_inverse=True)
    angles = _corner_angles(scaled, faces).reshape(-1, 1)
    weighted = np.repeat(normals, 3, axis=0) * angles
    total = np.zeros((int(corner_index.max()) + 1, 3))
    np.add.at(total, corner_index, weighted)
    corner = total[corner_index]
    length = norm(corner)[:, None]
    flat = np.repeat(normals, 3, axis=0)
    corner = np.where(length > 1e-12, corner / np.maximum(length, 1e-12), flat)
    count = len(faces)
    return MeshPart(
        vertices=scaled,
        faces=faces,
        normals=corner.reshape(count, 3, 3).astype(np.float32),
        uv=_box_uv(unit, faces),
        tangents=np.zeros((count, 2, 3), np.float32),
        groups=groups,
        materials=np.full(count, material, np.int32),
    )


def sheet(resolution: int, material: int) -> MeshPart:
    """Return a cloth of ``resolution`` x ``resolution`` vertices, which each frame fills in."""
    index = np.arange(resolution * resolution, dtype=np.int32).reshape(resolution, resolution)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    )
    u, v = np.divmod(faces, resolution)
    count = len(faces)
    return MeshPart(
        vertices=np.zeros((resolution * resolution, 3)),
        faces=faces,
        normals=np.zeros((count, 3, 3), np.float32),
        uv=(np.stack([u, v], -1) / (resolution - 1)).astype(np.float32),
        tangents=np.zeros((count, 2, 3), np.float32),
        groups=np.zeros(count, np.int32),
        materials=np.full(count, material, np.int32),
        two_sided=True,
    )


def _merge(vertices: F64, faces: I32) -> tuple[F64, I32]:
    """Join vertices at the same position (to a micrometre); drop triangles that become lines."""
    _, first, inverse = np.unique(
        np.round(vertices, 6), axis=0, return_index=True, return_inverse=True
    )
    merged = inverse.reshape(-1)[faces].astype(np.int32)
    kept = (
        (merged[:, 0] != merged[:, 1])
        & (merged[:, 1] != merged[:, 2])
        & (merged[:, 2] != merged[:, 0])
    )
    return vertices[first], np.ascontiguousarray(merged[kept])


def _smooth_groups(faces: I32, normals: F64, threshold: float) -> I32:
    """Return the smooth surface (T,) of each triangle.

    Two triangles with a common edge belong together if the cosine of the angle between their
    ``normals`` exceeds ``threshold``.
    """
    count = len(faces)
    edges = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1).reshape(-1, 2), axis=1)
    owner = np.repeat(np.arange(count), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    same = (edges[1:] == edges[:-1]).all(axis=1)
    a, b = owner[:-1][same], owner[1:][same]
    soft = dot(normals[a], normals[b]) > threshold
    return _components(count, a[soft], b[soft])


def _components(count: int, a: NDArray[np.intp], b: NDArray[np.intp]) -> I32:
    """Return the connected component of each of ``count`` nodes joined by the pairs (a, b).

    Every node takes the smallest label among its neighbours, then its label's label, until
    nothing changes.
    """
    label = np.arange(count)
    while True:
        before = label.copy()
        smaller = np.minimum(label[a], label[b])
        np.minimum.at(label, label[a], smaller)
        np.minimum.at(label, label[b], smaller)
        label = label[label]
        if (label == before).all():
            return np.unique(label, return_inverse=True)[1].reshape(-1).astype(np.int32)


def _corner_angles(vertices: F64, faces: I32) -> F64:
    """Return the angle in radians of each corner of each triangle, (T, 3)."""
    corners = vertices[faces]
    ahead = np.roll(corners, -1, axis=1) - corners
    behind = np.roll(corners, 1, axis=1) - corners
    scale = norm(ahead) * norm(behind)
    cosine = dot(ahead, behind) / np.maximum(scale, 1e-300)
    return arccos(np.clip(cosine, -1.0, 1.0))


def _box_uv(unit: F64, faces: I32) -> F32:
    """Return texture coordinates (T, 3, 2) in 0..1 on the side of the bounding box they face."""
    low, size = unit.min(axis=0), np.ptp(unit, axis=0)
    relative = (unit - low) / np.where(size > 0, size, 1.0)
    relative = UV_MARGIN + UV_SPAN * relative
    axis = np.abs(face_normals(unit, faces)).argmax(axis=1)
    # v, the direction of the grain, is z on the sides and x on top, as on an upright plank.
    pairs = np.array([[1, 2], [0, 2], [1, 0]])[axis]
    corners = relative[faces]
    return np.take_along_axis(corners, pairs[:, None, :].repeat(3, 1), axis=2).astype(np.float32)
