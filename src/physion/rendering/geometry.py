"""Triangles ready to be drawn: corner normals, texture coordinates, surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from physion.numerics.elementary import arccos, cos
from physion.numerics.linear_algebra import dot, norm

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

FLAT = np.radians(1.0)
"""Triangles that meet at a smaller angle than this lie in one face, in radians."""


@dataclass(frozen=True)
class Part:
    """One mesh in the axes of its body. V vertices, T triangles.

    - ``vertices`` (V, 3): metres. ``faces`` (T, 3): counter-clockwise seen from outside.
    - ``normals`` (T, 9): unit normals of the three corners.
    - ``uv`` (T, 6): texture coordinates of the three corners; the texture repeats each unit.
    - ``tangents`` (T, 6): world directions of growing u and v, zero where no relief is drawn.
    - ``surfaces`` (T,): triangles with one number make one smooth surface, so that a pixel that
      shows several of them is shaded once.
    - ``materials`` (T,): row in the table of materials.
    """

    vertices: F64
    faces: I32
    normals: F32
    uv: F32
    tangents: F32
    surfaces: I32
    materials: I32
    two_sided: bool = False


def face_normals(vertices: F64, faces: I32) -> F64:
    """Return the unit normals (T, 3); zero for a triangle without area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    length = norm(cross)[:, None]
    return np.asarray(np.divide(cross, length, out=np.zeros_like(cross), where=length > 0))


def solid(vertices: F64, faces: I32, scale: F64, crease: float, material: int) -> Part:
    """A body's mesh at unit scale as a `Part` in metres.

    Triangles that meet at an angle below ``crease`` (radians, at unit scale) are shaded round.
    Texture coordinates are taken before scaling, from the side of the unit box that a triangle
    faces: a texture stretches with its body, as it does in the original stimuli.
    """
    unit, faces = _merge(np.asarray(vertices, np.float64), np.asarray(faces, np.int32))
    scaled = unit * scale
    surfaces = _surfaces(faces, face_normals(unit, faces), cos(max(crease, FLAT)))
    normals = face_normals(scaled, faces)
    key = faces.astype(np.int64) + len(unit) * surfaces[:, None].astype(np.int64)
    _, group = np.unique(key.ravel(), return_inverse=True)
    angles = _corner_angles(scaled, faces).reshape(-1, 1)
    weighted = np.repeat(normals, 3, axis=0) * angles
    total = np.zeros((int(group.max()) + 1, 3))
    np.add.at(total, group, weighted)
    corner = total[group]
    length = norm(corner)[:, None]
    flat = np.repeat(normals, 3, axis=0)
    corner = np.where(length > 1e-12, corner / np.maximum(length, 1e-12), flat)
    count = len(faces)
    return Part(
        vertices=scaled,
        faces=faces,
        normals=corner.reshape(count, 9).astype(np.float32),
        uv=_box_uv(unit, faces).reshape(count, 6),
        tangents=np.zeros((count, 6), np.float32),
        surfaces=surfaces,
        materials=np.full(count, material, np.int32),
    )


def sheet(resolution: int, material: int) -> Part:
    """A cloth: a grid of ``resolution`` x ``resolution`` vertices that come with each frame."""
    index = np.arange(resolution * resolution, dtype=np.int32).reshape(resolution, resolution)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.concatenate(
        [np.stack([a, b, c], -1).reshape(-1, 3), np.stack([a, c, d], -1).reshape(-1, 3)]
    )
    u, v = np.divmod(faces, resolution)
    count = len(faces)
    return Part(
        vertices=np.zeros((resolution * resolution, 3)),
        faces=faces,
        normals=np.zeros((count, 9), np.float32),
        uv=(np.stack([u, v], -1) / (resolution - 1)).reshape(count, 6).astype(np.float32),
        tangents=np.zeros((count, 6), np.float32),
        surfaces=np.zeros(count, np.int32),
        materials=np.full(count, material, np.int32),
        two_sided=True,
    )


def _merge(vertices: F64, faces: I32) -> tuple[F64, I32]:
    """Make vertices at one place (to a micrometre) one vertex, and drop triangles that vanish."""
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


def _surfaces(faces: I32, normals: F64, threshold: float) -> I32:
    """Number the groups of triangles that meet at edges less sharp than ``threshold`` (cosine)."""
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
    """Number the connected groups of ``count`` nodes that the pairs (a, b) join.

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
    """Texture coordinates (T, 3, 2) in 0..1 from the side of the bounding box that is faced."""
    low, size = unit.min(axis=0), np.ptp(unit, axis=0)
    at = (unit - low) / np.where(size > 0, size, 1.0)
    at = 0.002 + 0.996 * at  # keep off the seam of the texture
    axis = np.abs(face_normals(unit, faces)).argmax(axis=1)
    # Grain runs along z on the sides and along x on top, as on a plank that stands.
    pairs = np.array([[1, 2], [0, 2], [1, 0]])[axis]
    corners = at[faces]
    return np.take_along_axis(corners, pairs[:, None, :].repeat(3, 1), axis=2).astype(np.float32)
