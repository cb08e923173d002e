"""Solids from which props are built: boxes, limbs, surfaces of revolution, tubes and lofts.

A prop is modelled in metres at its natural size with its front towards +y, and then scaled to the
box [-0.5, 0.5] x [-0.5, 0.5] x [0, 1], so that the scale of a body is its size in metres.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.numerics.elementary import cos, sin
from physion.numerics.linear_algebra import apply, dot, multiply, norm, ordered_mean, unit
from physion.numerics.rotations import axis_angle_matrix
from physion.scenes.scene import Look, Vec3
from physion.scenes.shapes.meshes import Mesh, Points, box, hull, merge, revolve, solid_properties
from physion.scenes.shapes.primitives import CURVED, PREFIX, Shape, ball_mesh, convex, shapes

# Parts of props with looks of their own; registration of a prop as a shape.

NATURAL_SIZES: dict[str, Vec3] = {}
"""Natural width, depth and height of each prop in metres, by name without prefix."""


@dataclass(frozen=True)
class PropShape(Shape):
    """Shape whose triangles may have looks of their own.

    - ``paint`` (F,): per triangle 0 for the look of the body, or i for ``own_looks[i - 1]``.
    """

    paint: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    own_looks: tuple[Look, ...] = ()


@dataclass(frozen=True, eq=False)
class PropPart:
    """One closed solid of a prop.

    - ``mesh``: its mesh, metres. ``pieces``: corners (K, 3) of its convex collision pieces.
    - ``look``: its look, None for the body's look.
    - ``patches``: masks (F,) of triangles with looks of their own; a later one takes precedence.
    """

    mesh: Mesh
    pieces: tuple[Points, ...] = ()
    look: Look | None = None
    patches: tuple[tuple[NDArray[np.bool_], Look], ...] = ()

    def moved(self, offset: ArrayLike) -> PropPart:
        """Return the part shifted by ``offset``, metres."""
        shift = np.asarray(offset, np.float64)
        pieces = tuple(piece + shift for piece in self.pieces)
        return replace(self, mesh=self.mesh.moved(offset=shift), pieces=pieces)

    def rotated(self, axis: ArrayLike, angle: float, about: ArrayLike = (0, 0, 0)) -> PropPart:
        """Return the part rotated by ``angle`` (radians) about ``axis`` through ``about``."""
        matrix, center = axis_angle_matrix(axis, angle), np.asarray(about, np.float64)
        shift = center - apply(matrix, center)
        pieces = tuple(apply(matrix, piece) + shift for piece in self.pieces)
        return replace(self, mesh=self.mesh.rotated(matrix).moved(offset=shift), pieces=pieces)

    def patched(self, where: Callable[[Points, Points], NDArray[np.bool_]], look: Look) -> PropPart:
        """Return a copy with ``look`` on the triangles for which ``where(centers, normals)``."""
        corners = self.mesh.vertices[self.mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        mask = np.asarray(where(ordered_mean(corners, axis=1), unit(normals)), np.bool_)
        return replace(self, patches=(*self.patches, (mask, look)))


PartsBuilder = Callable[[], Iterable[PropPart]]


def prop(name: str, size: Vec3) -> Callable[[PartsBuilder], PartsBuilder]:
    """Return a decorator that registers a generator of parts as the shape ``prop:name``.

    ``size`` is the natural width, depth and height in metres.
    """
    NATURAL_SIZES[name] = size

    def add(parts_of: PartsBuilder) -> PartsBuilder:
        shapes.register(PREFIX + name)(lambda: _fit_to_unit_box(name, list(parts_of())))
        return parts_of

    return add


def _fit_to_unit_box(name: str, parts: list[PropPart]) -> PropShape:
    whole = merge((part.mesh for part in parts), smooth=CURVED)
    low, high = whole.bounds
    scale = 1 / (high - low)
    offset = -scale * np.array([*(low + high)[:2] / 2, low[2]])
    pieces = [convex(piece * scale + offset) for part in parts for piece in part.pieces]
    looks = [look for part in parts for look in (part.look, *(p[1] for p in part.patches))]
    own_looks = tuple(dict.fromkeys(look for look in looks if look is not None))
    paint = np.concatenate([_paint(part, own_looks) for part in parts])
    return PropShape(
        PREFIX + name,
        whole.moved(scale, offset),
        tuple(pieces),
        hollow=len(pieces) > 1,
        paint=paint,
        own_looks=own_looks,
    )


def _paint(part: PropPart, own_looks: tuple[Look, ...]) -> NDArray[np.int32]:
    index = 0 if part.look is None else 1 + own_looks.index(part.look)
    paint = np.full(len(part.mesh.faces), index, np.int32)
    for mask, look in part.patches:
        paint[mask] = 1 + own_looks.index(look)
    return paint


SIDES = 24
"""Number of sides of a surface of revolution."""


def solid(mesh: Mesh, look: Look | None = None) -> PropPart:
    """Return a part of a convex mesh, which is also its collision piece."""
    return PropPart(mesh, (mesh.vertices,), look)


def board(center: ArrayLike, half: ArrayLike, look: Look | None = None) -> PropPart:
    """Return a box with this centre and these half sizes."""
    return solid(box(center, half), look)


def block(low: Sequence[float], high: Sequence[float], bottom: float, top: float) -> PropPart:
    """Return a tapered box: half sizes ``low`` at height ``bottom``, ``high`` at ``top``."""
    signs = [(x, y) for x in (-1, 1) for y in (-1, 1)]
    points = [(x * low[0], y * low[1], bottom) for x, y in signs]
    return solid(hull(points + [(x * high[0], y * high[1], top) for x, y in signs]))


def cushion(
    center: ArrayLike, half: ArrayLike, radius: float, look: Look | None = None
) -> PropPart:
    """Return a box with edges rounded by ``radius``."""
    ball = ball_mesh(radius, 12).vertices
    inner = np.asarray(half, np.float64) - radius
    signs = itertools.product((-1, 1), repeat=3)
    points = np.concatenate([ball + inner * np.array(sign) for sign in signs])
    return solid(hull(points + np.asarray(center), CURVED), look)


def limb(
    start: ArrayLike,
    end: ArrayLike,
    thick: float,
    thin: float | None = None,
    look: Look | None = None,
) -> PropPart:
    """Return a rounded cone from ``start`` (radius ``thick``) to ``end`` (radius ``thin``)."""
    first = ball_mesh(thick, 10).moved(offset=start).vertices
    last = ball_mesh(thick if thin is None else thin, 10).moved(offset=end).vertices
    return solid(hull(np.concatenate([first, last]), CURVED), look)


def ball(center: ArrayLike, half: ArrayLike, look: Look | None = None, sides: int = 16) -> PropPart:
    """Return an ellipsoid with this centre and these half axes."""
    return solid(ball_mesh(1.0, sides).moved(half, center), look)


def lathe(
    outline: Sequence[tuple[float, float]],
    wall: float | None = None,
    look: Look | None = None,
    sides: int = SIDES,
) -> PropPart:
    """Return the surface of revolution of an ``outline`` of (radius, height) from the bottom up.

    It is hollow and open above if a thickness ``wall`` is given. Its collision pieces are full
    slices between neighbouring points.
    """
    (_, bottom), (_, top) = outline[0], outline[-1]
    profile = [(0.0, bottom), *outline]
    if wall is None:
        profile.append((0.0, top))
    else:
        inside = [(max(r - wall, 0.3 * r), z) for r, z in outline if z > bottom + wall]
        profile += [*reversed(inside), (0.0, inside[0][1])]
    slices = [
        revolve([(0.0, a[1]), a, b, (0.0, b[1])], 12).vertices
        for a, b in itertools.pairwise(outline)
        if b[1] > a[1]
    ]
    return PropPart(revolve(profile, sides, smooth=CURVED), tuple(slices), look)


def sleeve(
    outline: Sequence[tuple[float, float]], wall: float, look: Look | None = None
) -> PropPart:
    """Return a round wall, open above and below, as a lamp shade; its pieces are full slices."""
    inside = [(r - wall, z) for r, z in reversed(outline)]
    mesh = revolve([*outline, *inside], SIDES, closed=True, smooth=CURVED)
    return replace(lathe(outline, look=look), mesh=mesh)


def curve(points: Sequence[Sequence[float]] | Sequence[Points], steps: int = 5) -> Points:
    """Return a Catmull-Rom spline (K, D) through ``points``, with ``steps`` points per span."""
    p = np.asarray(points, np.float64)
    p = np.concatenate([p[:1], p, p[-1:]])
    t = np.linspace(0, 1, steps, endpoint=False)[:, None]
    spans = []
    for a, b, c, d in zip(p, p[1:], p[2:], p[3:], strict=False):
        bend = (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * (t * t * t)
        spans.append(0.5 * (2 * b + (c - a) * t + bend))
    return np.concatenate([*spans, p[-1:]])


def outline(points: Sequence[tuple[float, float]], steps: int = 3) -> list[tuple[float, float]]:
    """Return a smooth outline of (radius, height) through ``points``, for `lathe`."""
    return [(float(r), float(z)) for r, z in curve(points, steps)]


def tube(
    path: ArrayLike,
    radii: ArrayLike,
    look: Look | None = None,
    *,
    sides: int = 8,
    rounded: bool = False,
    closed: bool = False,
) -> PropPart:
    """Return a tube along ``path`` with elliptic cross-sections.

    Parameters
    ----------
    path
        Points (K, 3).
    radii
        One radius, one per point (K,), or two per point (K, 2), of which the first is horizontal
        unless the path is vertical.
    look
        Look of the part.
    sides
        Number of sides of the cross-section.
    rounded
        Add domes at both ends.
    closed
        Connect the end of the path with its start.
    """
    points = np.asarray(path, np.float64)
    given = np.asarray(radii, np.float64)
    if given.ndim < 2:
        given = given.reshape(-1, 1)
    sizes = np.broadcast_to(given, (len(points), 2))
    across, up, ahead_axes = _frames(points, closed)
    if rounded:
        points, sizes, across, up = _domed(points, sizes, across, up, ahead_axes)
    angles = 2 * math.pi * np.arange(sides) / sides
    section = np.stack([cos(angles), sin(angles)], axis=1)
    spokes = np.stack([across * sizes[:, :1], up * sizes[:, 1:]], axis=1)
    rings = points[:, None] + multiply(section, spokes)
    part = loft(rings, look, closed=closed)
    if not rounded:
        return part
    # A dome belongs to the piece that it ends.
    cuts = [0, *range(4, len(rings) - 4), len(rings) - 1]
    pieces = [rings[a : b + 1].reshape(-1, 3) for a, b in itertools.pairwise(cuts)]
    return replace(part, pieces=tuple(pieces))


def loft(rings: Points, look: Look | None = None, *, closed: bool = False) -> PropPart:
    """Return the surface through rings (K, S, 3) of corners, with closed ends.

    A ``closed`` loft connects the last ring with the first instead. The collision pieces are the
    hulls of neighbouring rings.
    """
    count, sides = rings.shape[:2]
    index = np.arange(count * sides).reshape(count, sides)
    if closed:
        index = np.concatenate([index, index[:1]])
    low, high = index[:-1], index[1:]
    ahead, above = np.roll(low, -1, axis=1), np.roll(high, -1, axis=1)
    faces = [np.stack(x, axis=-1).reshape(-1, 3) for x in ((low, ahead, above), (low, above, high))]
    vertices = rings.reshape(-1, 3)
    if not closed:
        vertices = np.concatenate([vertices, ordered_mean(rings[[0, -1]], axis=1)])
        first, last = count * sides, count * sides + 1
        faces.append(np.stack([np.full(sides, first), np.roll(index[0], -1), index[0]], axis=1))
        faces.append(np.stack([np.full(sides, last), index[-1], np.roll(index[-1], -1)], axis=1))
    mesh = Mesh(vertices, np.concatenate(faces).astype(np.int32), CURVED)
    if solid_properties(mesh)[0] < 0:
        mesh = replace(mesh, faces=np.ascontiguousarray(mesh.faces[:, ::-1]))
    around = [*rings, rings[0]] if closed else list(rings)
    pieces = tuple(np.concatenate(pair) for pair in itertools.pairwise(around))
    return PropPart(mesh, pieces, look)


def arc(
    center: ArrayLike, right: ArrayLike, up: ArrayLike, first: float, last: float, count: int
) -> Points:
    """Return ``count`` points (K, 3) of an elliptic arc between two angles in radians."""
    angles = np.linspace(first, last, count)[:, None]
    middle, x, y = (np.asarray(v, np.float64) for v in (center, right, up))
    return np.asarray(middle + cos(angles) * x + sin(angles) * y)


def ring(x: float, y: float, z: float) -> list[Vec3]:
    """Return the 12 corners of a horizontal ellipse at height ``z``."""
    angles = 2 * math.pi * np.arange(12) / 12
    return [(x * cos(t), y * sin(t), z) for t in angles]


def _frames(points: Points, closed: bool) -> tuple[Points, Points, Points]:
    """Return a rotation-minimising frame along a path: axes across, up and ahead, each (K, 3)."""
    ahead = np.roll(points, -1, axis=0) - points
    behind = points - np.roll(points, 1, axis=0)
    if not closed:
        ahead[-1], behind[0] = behind[-1], ahead[0]
    ahead_axes = unit(unit(ahead) + unit(behind))
    level = np.cross(ahead_axes[0], (0.0, 0.0, 1.0))
    across = level if norm(level) > 0.2 else np.array([1.0, 0.0, 0.0])
    axes = []
    for way in ahead_axes:
        across = unit(across - way * dot(across, way))
        axes.append(across)
    sideways = np.array(axes)
    return sideways, np.cross(sideways, ahead_axes), ahead_axes


def _domed(
    points: Points, sizes: Points, across: Points, up: Points, ahead_axes: Points
) -> tuple[Points, Points, Points, Points]:
    """Return the path with three more rings at each end that form a dome."""
    angles = np.radians([84.0, 60.0, 30.0])[:, None]
    first = points[0] - ahead_axes[0] * sin(angles) * sizes[0].min()
    last = points[-1] + ahead_axes[-1] * sin(angles[::-1]) * sizes[-1].min()
    return (
        np.concatenate([first, points, last]),
        np.concatenate([sizes[0] * cos(angles), sizes, sizes[-1] * cos(angles[::-1])]),
        np.concatenate([across[:1].repeat(3, 0), across, across[-1:].repeat(3, 0)]),
        np.concatenate([up[:1].repeat(3, 0), up, up[-1:].repeat(3, 0)]),
    )
