"""Visibility: which triangle each sample of each pixel shows; depth maps; the G-buffer.

Triangles are drawn in homogeneous pixel coordinates (x w, y w, w), where w is the depth in metres,
so a triangle that crosses the plane of the camera needs no clipping (Olano and Greer 1997). The
colour pass takes five samples for each pixel, the other passes the one at its centre.

Letters in the kernels: T triangles, V vertices, H rows, W columns, S samples for each pixel.

References
----------
Pineda, J. (1988). A parallel algorithm for polygon rasterization. SIGGRAPH.
Olano, M. and Greer, T. (1997). Triangle scan conversion using 2D homogeneous coordinates.
    Graphics Hardware.
Burns, C. and Hunt, W. (2013). The visibility buffer: a cache-friendly approach to deferred
    shading. Journal of Computer Graphics Techniques 2(2).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.numerics.kernel import in_place_kernel
from physion.rendering.textures.atlas import Atlas

F32 = NDArray[np.float32]
F64 = NDArray[np.float64]
I16 = NDArray[np.int16]
I32 = NDArray[np.int32]
Bools = NDArray[np.bool_]
U8 = NDArray[np.uint8]
Records = NDArray[np.void]

SAMPLES = np.array([[0.0, 0.0], [-0.125, -0.375], [0.375, -0.125], [-0.375, 0.125], [0.125, 0.375]])
"""Offsets (S, 2) of the samples from the centre of a pixel: the centre, then a rotated grid."""
SAMPLE_REACH = 0.375
"""Largest offset of a sample along x or y."""
NOTHING = -1
"""Triangle id of a sample that no triangle covers."""
SHORTEST_NORMAL = 1e-12
"""Length below which an interpolated normal is not scaled up to one."""
BLOCK = 8
"""Texels along the side of a block of a `DepthMap`."""
EDGE_ROWS, EDGE_COLUMNS = 2, 1
"""Last row and column of blocks near the edge of a `DepthMap` in the sense of `mark_lookups`."""


class Triangles(NamedTuple):
    """Triangles to be drawn.

    - ``faces`` (T, 3) int32: vertex indices, counter-clockwise seen from outside.
    - ``two_sided`` (T,) bool: triangles whose back is drawn too.
    - ``edges`` (T, 3, 3) float64, written by `rasterize`: coefficients (of x, y, 1) of the three
      edge functions, see there; zero for a triangle that is not drawn.
    """

    faces: I32
    two_sided: Bools
    edges: F64


class DepthRange(NamedTuple):
    """Depths in metres between which surfaces are drawn: 0 < ``near`` < ``far``."""

    near: float
    far: float


class VisibilityBuffer(NamedTuple):
    """Nearest triangle of each sample (Burns and Hunt 2013).

    - ``triangle_ids`` (H, W, S) int32: index of the triangle, or `NOTHING`.
    - ``inverse_depth`` (H, W, S) float32: 1 / depth in 1/m; 0 where there is nothing.
    - ``drawn`` (H, W) bool: pixels of which `rasterize` has changed a sample.
    """

    triangle_ids: I32
    inverse_depth: F32
    drawn: Bools


class GeometryBuffers(NamedTuple):
    """The G-buffer: what the pixel centres show, apart from colour.

    - ``depth`` (H, W) float32: metres along the optical axis.
    - ``normals`` (H, W, 3) float32: unit vectors in the world.
    - ``object_ids`` (H, W) int16.
    - ``flow`` (H, W, 2) float32: pixels to the next frame.
    """

    depth: F32
    normals: F32
    object_ids: I16
    flow: F32


class SurfaceMotion(NamedTuple):
    """What `fill_geometry_buffers` reads besides the triangles.

    - ``normals`` (T, 3, 3) float32: normal of each corner in the world.
    - ``object_ids`` (T,) int32.
    - ``next_points`` (V, 3) float64: homogeneous pixels of the vertices in the next frame.
    """

    normals: F32
    object_ids: I32
    next_points: F64


@in_place_kernel
def transform(matrix: F64, points: F64, first: int, out: F64) -> None:
    """Write a matrix (3, 4) times the points (V, 3) from index ``first`` on to ``out`` (V, 3).

    The bits are those of `physion.numerics.linear_algebra.apply` and an addition.
    """
    for i in range(first, points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for k in range(3):
            out[i, k] = matrix[k, 0] * x + matrix[k, 1] * y + matrix[k, 2] * z + matrix[k, 3]


@in_place_kernel
def _bounds(points: F64, face: I32, near: float) -> tuple[float, float, float, float]:
    """Return left, right, top and bottom in pixels of the part of a triangle beyond ``near``.

    That part is a polygon whose corners are the triangle's corners beyond ``near`` and the points
    where its edges cross the plane w = near; the box around them is exact.
    """
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
            fraction = (near - aw) / (bw - aw)
            x = (ax + fraction * (points[b, 0] - ax)) / near
            y = (ay + fraction * (points[b, 1] - ay)) / near
            left, right = min(left, x), max(right, x)
            top, bottom = min(top, y), max(bottom, y)
    return left, right, top, bottom


@in_place_kernel
def _covered_pixels(low: float, high: float, size: int) -> tuple[int, int]:
    """Return the first and last pixel of ``size`` that may have a sample between two coordinates.

    A sample lies at most `SAMPLE_REACH` from the centre of its pixel, which is at index + 0.5.
    """
    first = int(max(0.0, np.ceil(max(low, -1.0) - 0.5 - SAMPLE_REACH)))
    last = int(min(size - 1.0, np.floor(min(high, size + 1.0) - 0.5 + SAMPLE_REACH)))
    return first, last


@in_place_kernel
def rasterize(
    points: F64, triangles: Triangles, first: int, depths: DepthRange, buffer: VisibilityBuffer
) -> None:
    """Draw the triangles from index ``first`` on into a visibility buffer.

    Parameters
    ----------
    points
        (V, 3) homogeneous pixels (x w, y w, w).
    triangles
        ``faces`` and ``two_sided`` are read, ``edges`` of the triangles drawn are written.
    first
        Index of the first triangle to draw.
    depths
        Surfaces nearer or farther than this are left out, sample by sample.
    buffer
        Updated where a triangle is nearer than what is there. Of equal depths the one drawn first
        stays.

    Notes
    -----
    With the corners v0, v1, v2 in homogeneous pixels, the edge functions (Pineda 1988) are

        E0(x, y) = (v1 x v2) . (x, y, 1) / det,   det = v0 . (v1 x v2),

    and E1, E2 with the indices rotated. A pixel lies in the triangle where all three are >= 0. The
    functions are linear in the picture, Ek = bk / w with the barycentric coordinate bk of the
    surface point, and their sum is 1 / w since the bk add up to 1 (Olano and Greer 1997).

    det < 0 for a triangle seen from its front, because y points down in the picture.

    The edge that two triangles share has exactly opposite coefficients in both, so that no sample
    on it is missed by both. A sample exactly on it belongs to both, and the depth test keeps one.
    """
    height, width, samples = buffer.triangle_ids.shape
    nearest, farthest = 1.0 / depths.near, 1.0 / depths.far
    for t in range(first, triangles.faces.shape[0]):
        for corner in range(3):
            for column in range(3):
                triangles.edges[t, corner, column] = 0.0
        i, j, k = triangles.faces[t, 0], triangles.faces[t, 1], triangles.faces[t, 2]
        x0, y0, w0 = points[i, 0], points[i, 1], points[i, 2]
        x1, y1, w1 = points[j, 0], points[j, 1], points[j, 2]
        x2, y2, w2 = points[k, 0], points[k, 1], points[k, 2]
        if w0 < depths.near and w1 < depths.near and w2 < depths.near:
            continue
        # Cross products: the coefficients (a, b, c) of the edge function opposite each corner.
        a0, b0, c0 = y1 * w2 - w1 * y2, w1 * x2 - x1 * w2, x1 * y2 - y1 * x2
        a1, b1, c1 = y2 * w0 - w2 * y0, w2 * x0 - x2 * w0, x2 * y0 - y2 * x0
        a2, b2, c2 = y0 * w1 - w0 * y1, w0 * x1 - x0 * w1, x0 * y1 - y0 * x1
        determinant = x0 * a0 + y0 * b0 + w0 * c0
        if determinant == 0.0 or (determinant > 0.0 and not triangles.two_sided[t]):
            continue
        left, right, top, bottom = _bounds(points, triangles.faces[t], depths.near)
        j0, j1 = _covered_pixels(left, right, width)
        i0, i1 = _covered_pixels(top, bottom, height)
        if j0 > j1 or i0 > i1:
            continue
        inverse = 1.0 / determinant
        edges = triangles.edges
        edges[t, 0, 0], edges[t, 0, 1], edges[t, 0, 2] = a0 * inverse, b0 * inverse, c0 * inverse
        edges[t, 1, 0], edges[t, 1, 1], edges[t, 1, 2] = a1 * inverse, b1 * inverse, c1 * inverse
        edges[t, 2, 0], edges[t, 2, 1], edges[t, 2, 2] = a2 * inverse, b2 * inverse, c2 * inverse
        # 1 / depth is the sum of the edge functions.
        da = (a0 + a1 + a2) * inverse
        db = (b0 + b1 + b2) * inverse
        dc = (c0 + c1 + c2) * inverse
        # Inside is where the functions have the sign of 1 / det; the factor itself is left out.
        if determinant < 0.0:
            a0, b0, c0, a1, b1, c1, a2, b2, c2 = -a0, -b0, -c0, -a1, -b1, -c1, -a2, -b2, -c2
        # Most that each function can gain from the centre of a pixel to one of its samples.
        m0 = SAMPLE_REACH * (abs(a0) + abs(b0))
        m1 = SAMPLE_REACH * (abs(a1) + abs(b1))
        m2 = SAMPLE_REACH * (abs(a2) + abs(b2))
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
                        if d > buffer.inverse_depth[row, column, s] and farthest <= d <= nearest:
                            buffer.inverse_depth[row, column, s] = d
                            buffer.triangle_ids[row, column, s] = t
                            buffer.drawn[row, column] = True


@in_place_kernel
def restore_pixels(static: VisibilityBuffer, buffer: VisibilityBuffer) -> None:
    """Take back what was drawn over ``static``: ``buffer`` is its copy again."""
    height, width, samples = buffer.triangle_ids.shape
    for row in range(height):
        for column in range(width):
            if buffer.drawn[row, column]:
                buffer.drawn[row, column] = False
                for s in range(samples):
                    buffer.triangle_ids[row, column, s] = static.triangle_ids[row, column, s]
                    buffer.inverse_depth[row, column, s] = static.inverse_depth[row, column, s]


@in_place_kernel
def rasterize_depth(
    points: F64, faces: I32, first: int, last: int, depth: F32, drawn: Bools
) -> None:
    """Lower a depth map to the smallest depth of the triangles ``first:last``.

    Parameters
    ----------
    points
        (V, 3): x and y in texels, depth in metres; a parallel projection.
    faces
        (T, 3) vertex indices; both sides of a triangle are drawn.
    first, last
        Range of triangles.
    depth
        (H, W) in metres, updated at texel centres (index + 0.5).
    drawn
        (H / `BLOCK`, W / `BLOCK`), set to true for blocks in which a texel was lowered.

    Notes
    -----
    Without perspective the barycentric coordinates are ratios of signed areas,
    b1 = area(v0, p, v2) / area(v0, v1, v2), and the depth is z0 + b1 (z1 - z0) + b2 (z2 - z0)
    (Pineda 1988).
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
                    drawn[row // BLOCK, column // BLOCK] = True


@in_place_kernel
def restore_blocks(static: F32, depth: F32, drawn: Bools) -> None:
    """Take back what was drawn over the depth map ``static``: ``depth`` is its copy again."""
    for i in range(drawn.shape[0]):
        for j in range(drawn.shape[1]):
            if drawn[i, j]:
                drawn[i, j] = False
                for row in range(i * BLOCK, (i + 1) * BLOCK):
                    for column in range(j * BLOCK, (j + 1) * BLOCK):
                        depth[row, column] = static[row, column]


@in_place_kernel
def bound_blocks(depth: F32, drawn: Bools, bounds: F32) -> None:
    """Write the smallest and the largest depth of each true block to ``bounds`` (rows, columns, 2).

    ``depth`` and ``drawn`` as in `rasterize_depth`.
    """
    for i in range(drawn.shape[0]):
        for j in range(drawn.shape[1]):
            if drawn[i, j]:
                low = high = depth[i * BLOCK, j * BLOCK]
                for row in range(i * BLOCK, (i + 1) * BLOCK):
                    for column in range(j * BLOCK, (j + 1) * BLOCK):
                        low = min(low, depth[row, column])
                        high = max(high, depth[row, column])
                bounds[i, j, 0], bounds[i, j, 1] = low, high


@in_place_kernel
def mark_neighbours(blocks: Bools, marked: Bools) -> None:
    """Mark the true blocks of a map and their eight neighbours, whatever was marked before."""
    rows, columns = blocks.shape
    for i in range(rows):
        for j in range(columns):
            if blocks[i, j]:
                for row in range(max(i - 1, 0), min(i + 2, rows)):
                    for column in range(max(j - 1, 0), min(j + 2, columns)):
                        marked[row, column] = True


@in_place_kernel
def mark_lookups(drawn: Bools, moved: Bools) -> None:
    """Mark in ``moved`` the blocks from which on a lookup reads a true block of ``drawn``.

    Lookups read two blocks in each direction, see `block_index`. Where nothing is near, they give
    1 without reading, and elsewhere a sum of weights: `lit_fraction`. That is exactly 1 from texel
    4 in x and 16 in y on, since fractions of a texel there have so few bits that no step rounds.
    Nearer to the edge, all lookups that a block may influence are marked.
    """
    rows, columns = drawn.shape
    for i in range(rows):
        for j in range(columns):
            if drawn[i, j]:
                wide = 1 if i <= EDGE_ROWS or j <= EDGE_COLUMNS else 0
                for row in range(max(i - 1 - wide, 0), min(i + 1 + wide, rows)):
                    for column in range(max(j - 1 - wide, 0), min(j + 1 + wide, columns)):
                        moved[row, column] = True


@in_place_kernel
def barycentric(edges: F64, t: int, x: float, y: float) -> tuple[float, float, float, float]:
    """Return depth and barycentric coordinates of the point of triangle ``t`` seen at a pixel.

    ``edges`` (T, 3, 3) as `rasterize` writes them; x and y are in pixels. With Ek = bk / w and
    b0 + b1 + b2 = 1: w = 1 / (E0 + E1 + E2) and bk = w Ek. The mean of the corners' values with
    the weights bk is perspective-correct interpolation (Olano and Greer 1997).
    """
    e0 = edges[t, 0, 0] * x + edges[t, 0, 1] * y + edges[t, 0, 2]
    e1 = edges[t, 1, 0] * x + edges[t, 1, 1] * y + edges[t, 1, 2]
    e2 = edges[t, 2, 0] * x + edges[t, 2, 1] * y + edges[t, 2, 2]
    w = 1.0 / (e0 + e1 + e2)
    return w, e0 * w, e1 * w, e2 * w


@in_place_kernel
def fill_geometry_buffers(
    triangle_ids: I32, triangles: Triangles, motion: SurfaceMotion, first: int, out: GeometryBuffers
) -> None:
    """Fill the G-buffer at pixel centres that show triangle ``first`` or a later one.

    Parameters
    ----------
    triangle_ids
        (H, W, S) triangles of a visibility buffer; the first sample is the pixel centre.
    triangles
        ``edges`` as `rasterize` wrote them for these ids.
    motion
        Corner normals, object ids, and the vertices in the next frame.
    first
        Index of the first triangle that is written; the other pixels stay as they are.
    out
        The buffers.

    Notes
    -----
    The point with barycentric coordinates b of a triangle keeps them while its corners move, so
    its next position in homogeneous pixels is b0 v0' + b1 v1' + b2 v2'. The flow is therefore
    exact for whatever moves its corners, rigid bodies and cloth alike. It is NaN for a point that
    passes behind the camera (w' <= 0).
    """
    height, width, _ = triangle_ids.shape
    for row in range(height):
        for column in range(width):
            t = triangle_ids[row, column, 0]
            if t < first:
                continue
            x, y = column + 0.5, row + 0.5
            w, b0, b1, b2 = barycentric(triangles.edges, t, x, y)
            out.depth[row, column] = w
            out.object_ids[row, column] = motion.object_ids[t]
            normals = motion.normals
            n0 = b0 * normals[t, 0, 0] + b1 * normals[t, 1, 0] + b2 * normals[t, 2, 0]
            n1 = b0 * normals[t, 0, 1] + b1 * normals[t, 1, 1] + b2 * normals[t, 2, 1]
            n2 = b0 * normals[t, 0, 2] + b1 * normals[t, 1, 2] + b2 * normals[t, 2, 2]
            length = max(np.sqrt(n0 * n0 + n1 * n1 + n2 * n2), SHORTEST_NORMAL)
            if triangles.two_sided[t] and shows_back(triangles.edges, t):
                length = -length
            out.normals[row, column, 0] = n0 / length
            out.normals[row, column, 1] = n1 / length
            out.normals[row, column, 2] = n2 / length
            i, j, k = triangles.faces[t, 0], triangles.faces[t, 1], triangles.faces[t, 2]
            following = motion.next_points
            nx = b0 * following[i, 0] + b1 * following[j, 0] + b2 * following[k, 0]
            ny = b0 * following[i, 1] + b1 * following[j, 1] + b2 * following[k, 1]
            nw = b0 * following[i, 2] + b1 * following[j, 2] + b2 * following[k, 2]
            if nw > 0.0:
                out.flow[row, column, 0] = nx / nw - x
                out.flow[row, column, 1] = ny / nw - y
            else:
                out.flow[row, column, 0] = np.nan
                out.flow[row, column, 1] = np.nan


@in_place_kernel
def shows_back(edges: F64, t: int) -> bool:
    """Whether the camera sees the back of triangle ``t``; ``edges`` as `rasterize` writes them.

    The edge functions are the inverse of the matrix of corners, so their determinant has its sign:
    positive where the corners run clockwise in the picture (y points down).
    """
    a0, b0, c0 = edges[t, 0, 0], edges[t, 0, 1], edges[t, 0, 2]
    a1, b1, c1 = edges[t, 1, 0], edges[t, 1, 1], edges[t, 1, 2]
    a2, b2, c2 = edges[t, 2, 0], edges[t, 2, 1], edges[t, 2, 2]
    determinant = a0 * (b1 * c2 - b2 * c1) - b0 * (a1 * c2 - a2 * c1) + c0 * (a1 * b2 - a2 * b1)
    return bool(determinant > 0.0)


# Depth maps of what lies between a surface and the light, or above the ground.
#
# The shadow map looks along the directional light; it tells how much of that light reaches a
# point. The occlusion map looks straight up from below; it tells how much of the sky over a point
# is hidden by things that stand on the ground near it or hang low above it.
#
# References
# ----------
# Reeves, W., Salesin, D. and Cook, R. (1987). Rendering antialiased shadows with depth maps.
#     SIGGRAPH.
# Bunnell, M. (2005). Dynamic ambient occlusion and indirect lighting. GPU Gems 2.

SHADOW_RADIUS = 2
"""Texels of the shadow map on each side of the nearest one that a lookup averages."""
SHADOW_AREA = float((2 * SHADOW_RADIUS + 1) * (2 * SHADOW_RADIUS + 1))
OCCLUSION_RADIUS = 3
"""Texels of the occlusion map on each side of the nearest one that a lookup averages."""
OCCLUSION_AREA = float((2 * OCCLUSION_RADIUS + 1) * (2 * OCCLUSION_RADIUS + 1))
OCCLUSION_REACH = 0.25
"""Metres above a point beyond which a thing does not darken it."""
OCCLUSION_TOLERANCE = 0.004
"""Metres by which a thing may lie lower than the point that it darkens."""


class DepthMap(NamedTuple):
    """Smallest depth of anything in each texel, by parallel projection.

    - ``matrix`` (3, 4) float64: from world (x, y, z, 1) to texel x, texel y, depth in metres.
    - ``depth`` (H, W) float32: metres; infinity where there is nothing.
    - ``occupied`` (H / BLOCK, W / BLOCK) bool: blocks of texels in which, or in a neighbour of
      which, there is anything. Elsewhere a lookup is skipped.
    - ``moved`` (H / BLOCK * W / BLOCK,) bool, row by row: where lookups of this `block_index` may
      read something that moves. The others give the same in every frame.
    - ``bounds`` (H / BLOCK, W / BLOCK, 2) float32: smallest and largest depth of each block, by
      which most lookups are known without reading the texels.
    """

    matrix: F64
    depth: F32
    occupied: Bools
    moved: Bools
    bounds: F32


@in_place_kernel
def block_index(depth_map: DepthMap, px: float, py: float, pz: float, radius: int) -> int:
    """Return the block, counted row by row, of the first texel that a lookup of a point reads.

    It reads ``radius`` texels on each side of the point and one more, at most `BLOCK` in all: none
    but those of this block and of the next ones in row and column. -1 if it would leave the map:
    then it reads nothing.
    """
    m = depth_map.matrix
    x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3] - 0.5
    y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3] - 0.5
    height, width = depth_map.depth.shape
    if x < radius or y < radius or x >= width - radius - 1 or y >= height - radius - 1:
        return -1
    return int((int(y) - radius) // BLOCK * (width // BLOCK) + (int(x) - radius) // BLOCK)


@in_place_kernel
def _window_bounds(bounds: F32, i: int, j: int, low: int, high: int) -> tuple[float, float]:
    """Return the smallest and the largest depth of the blocks of the texels that a lookup reads.

    They are in rows i + low to i + high and columns j + low to j + high, at most `BLOCK` each.
    """
    top, left, bottom, right = i + low, j + low, i + high, j + high
    top, left, bottom, right = top // BLOCK, left // BLOCK, bottom // BLOCK, right // BLOCK
    least = min(
        min(bounds[top, left, 0], bounds[top, right, 0]),
        min(bounds[bottom, left, 0], bounds[bottom, right, 0]),
    )
    most = max(
        max(bounds[top, left, 1], bounds[top, right, 1]),
        max(bounds[bottom, left, 1], bounds[bottom, right, 1]),
    )
    return least, most


@in_place_kernel
def lit_fraction(shadow: DepthMap, px: float, py: float, pz: float) -> float:
    """Return the fraction, 0..1, of the directional light that reaches a world point.

    Percentage-closer filtering (Reeves, Salesin and Cook 1987): the depth z of the point is
    compared with each texel near it, and the results are averaged,

        lit = sum of w_i [depth_i >= z] / sum of w_i.

    The window is 5 x 5 texels wide and centred on the point, not on a texel: of 6 x 6 texels the
    outer ones are weighted by the fraction that the window covers, so that shadows move smoothly.
    Outside the map everything is lit.
    """
    m, depth, occupied = shadow.matrix, shadow.depth, shadow.occupied
    x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3] - 0.5
    y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3] - 0.5
    low, high = -SHADOW_RADIUS, SHADOW_RADIUS + 1
    height, width = depth.shape
    if x < SHADOW_RADIUS or y < SHADOW_RADIUS or x >= width - high or y >= height - high:
        return 1.0
    j, i = int(x), int(y)
    if not occupied[i // BLOCK, j // BLOCK]:
        return 1.0
    z = m[2, 0] * px + m[2, 1] * py + m[2, 2] * pz + m[2, 3]
    ax, ay = x - j, y - i
    total = 0.0
    least, most = _window_bounds(shadow.bounds, i, j, low, high)
    if most < z:
        return 0.0
    if least >= z:  # the sum below for all texels, in its order, which gives its bits
        line = high - low - 1.0 + (1.0 - ax) + ax
        total = line * (1.0 - ay)
        for _ in range(low + 1, high):
            total += line
        return float((total + line * ay) / SHADOW_AREA)
    for row in range(low, high + 1):
        whole = 0
        for column in range(low + 1, high):
            if depth[i + row, j + column] >= z:
                whole += 1
        line = float(whole)
        if depth[i + row, j + low] >= z:
            line += 1.0 - ax
        if depth[i + row, j + high] >= z:
            line += ax
        total += line * (1.0 - ay if row == low else (ay if row == high else 1.0))
    return float(total / SHADOW_AREA)


@in_place_kernel
def occluded_fraction(occlusion: DepthMap, px: float, py: float, pz: float) -> float:
    """Return how much of the surroundings of a world point is hidden by things above it, 0..1.

    Each texel near the point whose lowest thing is ``gap`` metres above it counts
    1 - gap / `OCCLUSION_REACH`, nothing beyond that reach; the result is the mean over a window of
    7 x 7 texels, centred on the point as in `lit_fraction`. It stands for the integral of hidden
    directions over the hemisphere (Bunnell 2005), of which nearer things hide more.
    """
    m, depth, occupied = occlusion.matrix, occlusion.depth, occlusion.occupied
    x = m[0, 0] * px + m[0, 1] * py + m[0, 2] * pz + m[0, 3] - 0.5
    y = m[1, 0] * px + m[1, 1] * py + m[1, 2] * pz + m[1, 3] - 0.5
    low, high = -OCCLUSION_RADIUS, OCCLUSION_RADIUS + 1
    height, width = depth.shape
    if x < OCCLUSION_RADIUS or y < OCCLUSION_RADIUS or x >= width - high or y >= height - high:
        return 0.0
    j, i = int(x), int(y)
    if not occupied[i // BLOCK, j // BLOCK]:
        return 0.0
    least, most = _window_bounds(occlusion.bounds, i, j, low, high)
    if least - pz >= OCCLUSION_REACH or most - pz <= -OCCLUSION_TOLERANCE:
        return 0.0
    ax, ay = x - j, y - i
    total = 0.0
    for row in range(low, high + 1):
        line = 0.0
        for column in range(low, high + 1):
            gap = depth[i + row, j + column] - pz
            if -OCCLUSION_TOLERANCE < gap < OCCLUSION_REACH:
                weight = 1.0 - gap / OCCLUSION_REACH
                line += weight * (1.0 - ax if column == low else (ax if column == high else 1.0))
        total += line * (1.0 - ay if row == low else (ay if row == high else 1.0))
    return float(total / OCCLUSION_AREA)


# Records that the colour pass reads and writes: camera, surfaces, materials, light, points.
#
# Fields of one kind stand side by side in one array of records. With one array for each field, in
# nested NamedTuples, the colour pass took 1.5 times as long: numba passes each array to each
# kernel by value and counts references to it.

CAMERA = np.dtype([("position", "f8", 3), ("rays", "f8", (3, 3))], align=True)
"""The camera: its position in metres; the matrix from a pixel (x, y, 1) to the world vector from
the camera to depth 1 m."""
SURFACE = np.dtype(
    [
        ("normals", "f4", (3, 3)),
        ("uv", "f4", (3, 2)),
        ("tangents", "f4", (2, 3)),
        ("material", "i4"),
    ],
    align=True,
)
"""A triangle.

- ``normals``: normal of each corner in the world. ``uv``: texture coordinates of each corner.
- ``tangents``: world directions of growing u and v.
- ``material``: index of its `MATERIAL`.
"""
MATERIAL = np.dtype(
    [
        *(("color", "f8", 3), ("texture", "i8"), ("specular", "f8"), ("exponent", "f8")),
        *(("reflectance", "f8"), ("metalness", "f8"), ("normal_scale", "f8")),
        *(("emission", "f8"), ("occluded", "?")),
    ],
    align=True,
)
"""A surface material.

- ``color``: linear colour; the albedo is its product with the texture. ``texture``: index into the
  atlas.
- ``specular``, ``exponent``: strength and exponent of the highlight.
- ``reflectance``: fraction of the environment that is reflected seen straight on.
- ``metalness``: 0 dielectric .. 1 metal, whose reflections have the colour of its albedo.
- ``normal_scale``: factor of the texture's slopes in the normal map; 0 is without.
- ``emission``: light of its own, as a multiple of the albedo.
- ``occluded``: whether the room's walls darken it near the edges between them.
"""
LIGHT = np.dtype(
    [
        *(("direction", "f8", 3), ("color", "f8", 3)),
        *(("ambient", "f8", 3), ("ambient_slopes", "f8", (3, 3)), ("environment", "f8", (3, 3))),
        *(("window_low", "f8", 3), ("window_high", "f8", 3), ("window_color", "f8", 3)),
        *(("room_low", "f8", 3), ("room_high", "f8", 3), ("background", "f8", 3)),
        *(("shadow_strength", "f8"), ("occlusion_strength", "f8")),
    ],
    align=True,
)
"""Light of a room; colours are linear.

- ``direction``: unit vector towards the directional light. ``color``: its colour.
- ``ambient``, ``ambient_slopes``: the ambient light of a normal n is
  ``ambient + n @ ambient_slopes``, so that walls differ.
- ``environment``: what reflections show at the sides, below and above (rows).
- ``window_low``, ``window_high``, ``window_color``: corners of a bright rectangle in a plane of one
  y, which reflections show too, and its colour.
- ``room_low``, ``room_high``: corners of the room, for ambient occlusion near its edges.
- ``background``: colour where nothing is seen.
- ``shadow_strength``: fraction of the directional light that a full shadow takes.
- ``occlusion_strength``: fraction of all light that full occlusion under objects takes.
"""
POINT = np.dtype(
    [
        *(("position", "f4", 3), ("normal", "f4", 3)),
        *(("ambient", "f4", 3), ("direct", "f4", 3), ("levelness", "f4")),
    ],
    align=True,
)
"""A surface point with its light before shadows.

- ``position``: metres in the world. ``normal``: unit, before normal mapping.
- ``ambient``: ambient light, environment and emission that the point sends.
- ``direct``: the directional light that it sends if lit.
- ``levelness``: 1 for a horizontal surface that faces up, 0 from 60 degrees on; the weight of the
  occlusion under objects.
"""


class ShadingInputs(NamedTuple):
    """Everything about a scene that is the same for all its pixels.

    - ``camera`` (1,) of `CAMERA`; ``lights`` (1,) of `LIGHT`; ``materials`` (M,) of `MATERIAL`.
    - ``edges`` (T, 3, 3): edge functions of the triangles, written by
      `physion.rendering.rasterizer.rasterize`.
    - ``surfaces`` (T,) of `SURFACE`; ``groups`` (T,): triangles of one number make one smooth
      surface and are shaded as one.
    - ``atlas``: the textures.
    - ``tones`` (TONES,) uint8: the sRGB bytes of linear light, see
      `physion.rendering.light.tone_table`.
    """

    camera: Records
    edges: F64
    surfaces: Records
    groups: I32
    materials: Records
    atlas: Atlas
    lights: Records
    tones: U8


class LightMaps(NamedTuple):
    """Depth maps of one frame: of the directional light, and of what hangs low over the ground."""

    shadow: DepthMap
    occlusion: DepthMap
