"""Parts of props with looks of their own; registration of a prop as a shape.

A prop is modelled in metres at its natural size with its front towards +y, and then scaled to the
box [-0.5, 0.5] x [-0.5, 0.5] x [0, 1], so that the scale of a body is its size in metres.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.numerics.linear_algebra import apply, ordered_mean, unit
from physion.numerics.rotations import axis_angle_matrix
from physion.scenes.scene import Look, Vec3
from physion.scenes.shapes.meshes import Mesh, Points, merge
from physion.scenes.shapes.primitives import CURVED, Shape, convex, shapes
from physion.scenes.shapes.prop_names import PREFIX

NATURAL_SIZES: dict[str, Vec3] = {}
"""Natural width, depth and height of each prop in metres, by name without prefix."""


@dataclass(frozen=True)
class PropShape(Shape):
    """Shape whose triangles may have looks of their own.

    - ``paint`` (F,): per triangle 0 for the look of the body, or i for ``own_looks[i - 1]``.
    - ``modelled_size``: size in metres at which the prop was modelled.
    """

    paint: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    own_looks: tuple[Look, ...] = ()
    modelled_size: Vec3 = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class PropPart:
    """One closed solid of a prop.

    - ``mesh``: its mesh, metres. ``pieces``: corners (K, 3) of its convex collision pieces.
    - ``look``: its look, None for that of the body.
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
    x, y, z = (float(side) for side in high - low)
    return PropShape(
        PREFIX + name,
        whole.moved(scale, offset),
        tuple(pieces),
        hollow=len(pieces) > 1,
        paint=paint,
        own_looks=own_looks,
        modelled_size=(x, y, z),
    )


def _paint(part: PropPart, own_looks: tuple[Look, ...]) -> NDArray[np.int32]:
    index = 0 if part.look is None else 1 + own_looks.index(part.look)
    paint = np.full(len(part.mesh.faces), index, np.int32)
    for mask, look in part.patches:
        paint[mask] = 1 + own_looks.index(look)
    return paint
