"""Which triangle is seen at each sample of each pixel, and the depth maps for shadows.

Triangles are drawn in homogeneous pixel coordinates (x w, y w, w), so a triangle that crosses the
plane of the camera needs no clipping (Olano and Greer 1997, "Triangle scan conversion using 2D
homogeneous coordinates"). With v0, v1, v2 the corners, the three edge functions are the cross
products of two of them; divided by the determinant, each is linear in the picture and equals
barycentric coordinate / depth. Their sum is 1 / depth.

An edge that two triangles share has, in both, exactly opposite coefficients; samples on it count
for both, and the nearer one stays: no cracks.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import kernel

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I32 = NDArray[np.int32]

SAMPLES = np.array([[0.0, 0.0], [-0.125, -0.375], [0.375, -0.125], [-0.375, 0.125], [0.125, 0.375]])
"""Offsets of the samples from the centre of a pixel. The first one alone makes the exact passes;
colour is the mean of all five."""

REACH = 0.375
NOTHING = -1
"""Triangle index of a sample where nothing is seen."""


@kernel
def _bounds(points: F64, face: I32, near: float) -> tuple[float, float, float, float]:
    """Smallest box of pixels around the part of a triangle that lies beyond ``near``."""
    left, right, top, bottom = np.inf, -np.inf, np.inf, -np.inf
    for k in range(3):
        a, b = face[k], face[(k + 1) % 3]
        ax, ay, aw = points[a, 0], points[a, 1], points[a, 2]
        bw = points[b, 2]
        if aw >= near:
            x, y = ax / aw, ay / aw
            left, right = min(left, x), max(right, x)
            top, bottom = min(top, y), max(bottom, y)
        if (aw >= near) != (bw >= near):
            share = (near - aw) / (bw - aw)
            x = (ax + share * (points[b, 0] - ax)) / near
            y = (ay + share * (points[b, 1] - ay)) / near
            left, right = min(left, x), max(right, x)
            top, bottom = min(top, y), max(bottom, y)
    return left, right, top, bottom


@kernel
def rasterize(
    points: F64,
    faces: I32,
    two_sided: NDArray[np.bool_],
    first: int,
    near: float,
    far: float,
    edges: F64,
    ids: I32,
    inverse_depth: F32,
) -> None:
    """Draw the triangles from index ``first`` on into ``ids`` and ``inverse_depth``.

    - ``points`` (V, 3): homogeneous pixels. ``faces`` (T, 3), counter-clockwise seen from outside;
      the others are culled unless ``two_sided`` (T,).
    - ``edges`` (T, 9), written: for each corner the coefficients (of x, y, 1) of its barycentric
      coordinate / depth. Zeros for a triangle that is not seen.
    - ``ids`` (H, W, S), ``inverse_depth`` (H, W, S): updated where a triangle is nearer than what
      is there. Equal depths keep the one drawn first.
    """
    height, width, samples = ids.shape
    most, least = 1.0 / near, 1.0 / far
    for t in range(first, faces.shape[0]):
        for c in range(9):
            edges[t, c] = 0.0
        i, j, k = faces[t, 0], faces[t, 1], faces[t, 2]
        x0, y0, w0 = points[i, 0], points[i, 1], points[i, 2]
        x1, y1, w1 = points[j, 0], points[j, 1], points[j, 2]
        x2, y2, w2 = points[k, 0], points[k, 1], points[k, 2]
        if w0 < near and w1 < near and w2 < near:
            continue
        a0, b0, c0 = y1 * w2 - w1 * y2, w1 * x2 - x1 * w2, x1 * y2 - y1 * x2
        a1, b1, c1 = y2 * w0 - w2 * y0, w2 * x0 - x2 * w0, x2 * y0 - y2 * x0
        a2, b2, c2 = y0 * w1 - w0 * y1, w0 * x1 - x0 * w1, x0 * y1 - y0 * x1
        determinant = x0 * a0 + y0 * b0 + w0 * c0
        if determinant == 0.0 or (determinant > 0.0 and not two_sided[t]):
            continue
        left, right, top, bottom = _bounds(points, faces[t], near)
        # A sample lies at most REACH from the centre of its pixel, which is at j + 0.5.
        j0 = int(max(0.0, np.ceil(max(left, -1.0) - 0.5 - REACH)))
        j1 = int(min(width - 1.0, np.floor(min(right, width + 1.0) - 0.5 + REACH)))
        i0 = int(max(0.0, np.ceil(max(top, -1.0) - 0.5 - REACH)))
        i1 = int(min(height - 1.0, np.floor(min(bottom, height + 1.0) - 0.5 + REACH)))
        if j0 > j1 or i0 > i1:
            continue
        inverse = 1.0 / determinant
        edges[t, 0], edges[t, 1], edges[t, 2] = a0 * inverse, b0 * inverse, c0 * inverse
        edges[t, 3], edges[t, 4], edges[t, 5] = a1 * inverse, b1 * inverse, c1 * inverse
        edges[t, 6], edges[t, 7], edges[t, 8] = a2 * inverse, b2 * inverse, c2 * inverse
        da = (a0 + a1 + a2) * inverse
        db = (b0 + b1 + b2) * inverse
        dc = (c0 + c1 + c2) * inverse
        if determinant < 0.0:
            a0, b0, c0, a1, b1, c1, a2, b2, c2 = -a0, -b0, -c0, -a1, -b1, -c1, -a2, -b2, -c2
        m0 = REACH * (abs(a0) + abs(b0))
        m1 = REACH * (abs(a1) + abs(b1))
        m2 = REACH * (abs(a2) + abs(b2))
        for row in range(i0, i1 + 1):
            yc = row + 0.5
            r0, r1, r2 = b0 * yc + c0, b1 * yc + c1, b2 * yc + c2
            for column in range(j0, j1 + 1):
                xc = column + 0.5
                if a0 * xc + r0 < -m0 or a1 * xc + r1 < -m1 or a2 * xc + r2 < -m2:
                    continue
                for s in range(samples):
                    x, y = xc + SAMPLES[s, 0], yc + SAMPLES[s, 1]
                    if (
                        a0 * x + (b0 * y + c0) >= 0.0
                        and a1 * x + (b1 * y + c1) >= 0.0
                        and a2 * x + (b2 * y + c2) >= 0.0
                    ):
                        d = np.float32(da * x + db * y + dc)
                        if d > inverse_depth[row, column, s] and least <= d <= most:
                            inverse_depth[row, column, s] = d
                            ids[row, column, s] = t


@kernel
def rasterize_depth(points: F64, faces: I32, first: int, last: int, depth: F32) -> None:
    """Lower ``depth`` (H, W) to the smallest third coordinate of the triangles ``first:last``.

    ``points`` (V, 3) are (x in texels, y in texels, depth), without perspective. Every side of a
    triangle counts. Texel centres are at j + 0.5.
    """
    height, width = depth.shape
    for t in range(first, last):
        i, j, k = faces[t, 0], faces[t, 1], faces[t, 2]
        x0, y0, z0 = points[i, 0], points[i, 1], points[i, 2]
        x1, y1, z1 = points[j, 0], points[j, 1], points[j, 2]
        x2, y2, z2 = points[k, 0], points[k, 1], points[k, 2]
        area = (x1 - x0) * (y2 - y0) - (x2 - x0) * (y1 - y0)
        if area == 0.0:
            continue
        j0 = int(np.ceil(max(min(x0, x1, x2) - 0.5, 0.0)))
        j1 = int(np.floor(min(max(x0, x1, x2) - 0.5, width - 1.0)))
        i0 = int(np.ceil(max(min(y0, y1, y2) - 0.5, 0.0)))
        i1 = int(np.floor(min(max(y0, y1, y2) - 0.5, height - 1.0)))
        inverse = 1.0 / area
        for row in range(i0, i1 + 1):
            y = row + 0.5
            for column in range(j0, j1 + 1):
                x = column + 0.5
                b1 = ((x - x0) * (y2 - y0) - (x2 - x0) * (y - y0)) * inverse
                b2 = ((x1 - x0) * (y - y0) - (x - x0) * (y1 - y0)) * inverse
                if b1 < 0.0 or b2 < 0.0 or b1 + b2 > 1.0:
                    continue
                z = np.float32(z0 + b1 * (z1 - z0) + b2 * (z2 - z0))
                if z < depth[row, column]:
                    depth[row, column] = z


@kernel
def measure(
    ids: I32,
    edges: F64,
    faces: I32,
    objects: I32,
    normals: F32,
    two_sided: NDArray[np.bool_],
    next_points: F64,
    first: int,
    depth: F32,
    normal: F32,
    identity: NDArray[np.int16],
    flow: F32,
) -> None:
    """Fill the exact passes at pixel centres that show triangle ``first`` or a later one.

    ``objects`` (T,) is what is written to ``identity``; ``normals`` (T, 9) are the corner normals
    in the world; ``next_points`` (V, 3) are the homogeneous pixels of the next frame. The surface
    point at a pixel is the same weighted mean of its corners in both frames, so the flow is exact
    for whatever moves its corners: rigid bodies and cloth alike.
    """
    height, width, _ = ids.shape
    for row in range(height):
        for column in range(width):
            t = ids[row, column, 0]
            if t < first:
                continue
            x, y = column + 0.5, row + 0.5
            e0 = edges[t, 0] * x + edges[t, 1] * y + edges[t, 2]
            e1 = edges[t, 3] * x + edges[t, 4] * y + edges[t, 5]
            e2 = edges[t, 6] * x + edges[t, 7] * y + edges[t, 8]
            w = 1.0 / (e0 + e1 + e2)
            e0, e1, e2 = e0 * w, e1 * w, e2 * w
            depth[row, column] = w
            identity[row, column] = objects[t]
            n0 = e0 * normals[t, 0] + e1 * normals[t, 3] + e2 * normals[t, 6]
            n1 = e0 * normals[t, 1] + e1 * normals[t, 4] + e2 * normals[t, 7]
            n2 = e0 * normals[t, 2] + e1 * normals[t, 5] + e2 * normals[t, 8]
            length = max(np.sqrt(n0 * n0 + n1 * n1 + n2 * n2), 1e-12)
            if two_sided[t] and _is_back(edges, t):
                length = -length
            normal[row, column, 0] = n0 / length
            normal[row, column, 1] = n1 / length
            normal[row, column, 2] = n2 / length
            i, j, k = faces[t, 0], faces[t, 1], faces[t, 2]
            nx = e0 * next_points[i, 0] + e1 * next_points[j, 0] + e2 * next_points[k, 0]
            ny = e0 * next_points[i, 1] + e1 * next_points[j, 1] + e2 * next_points[k, 1]
            nw = e0 * next_points[i, 2] + e1 * next_points[j, 2] + e2 * next_points[k, 2]
            if nw > 0.0:
                flow[row, column, 0] = nx / nw - x
                flow[row, column, 1] = ny / nw - y
            else:
                flow[row, column, 0] = np.nan
                flow[row, column, 1] = np.nan


@kernel
def _is_back(edges: F64, t: int) -> bool:
    """Whether the triangle shows its back: its corners run clockwise (y points down).

    The determinant of the nine coefficients has the sign of that of the corners.
    """
    a0, b0, c0 = edges[t, 0], edges[t, 1], edges[t, 2]
    a1, b1, c1 = edges[t, 3], edges[t, 4], edges[t, 5]
    a2, b2, c2 = edges[t, 6], edges[t, 7], edges[t, 8]
    turn = a0 * (b1 * c2 - b2 * c1) - b0 * (a1 * c2 - a2 * c1) + c0 * (a1 * b2 - a2 * b1)
    return bool(turn > 0.0)
