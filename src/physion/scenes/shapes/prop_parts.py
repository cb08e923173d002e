"""What a prop is: parts with looks of their own, fitted to the unit box and registered.

A prop is modelled in metres at its natural size, front towards +y, and then fitted to the box
[-0.5, 0.5] x [-0.5, 0.5] x [0, 1]: a body's scale is the size of the model that it stands for.
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
"""Width, depth and height in metres that each prop looks right at, by name without prefix."""


@dataclass(frozen=True)
class PropShape(Shape):
    """A shape whose triangles may have colours of their own.

    ``paint`` (triangles of the mesh,) is 0 where the look of the body is seen and i where
    ``own[i - 1]`` is. ``made`` is the size in metres in which the prop was modelled.
    """

    paint: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    own_looks: tuple[Look, ...] = ()
    modelled_size: Vec3 = (1.0, 1.0, 1.0)


@dataclass(frozen=True, eq=False)
class PropPart:
    """One closed solid of a prop, and the corners of the convex pieces that stand for it.

    ``look`` is its own colour and texture, None for those of the body. ``patches`` are looks of
    some of its triangles: masks (F,) with their looks, the last one wins.
    """

    mesh: Mesh
    pieces: tuple[Points, ...] = ()
    look: Look | None = None
    patches: tuple[tuple[NDArray[np.bool_], Look], ...] = ()

    def moved(self, offset: ArrayLike) -> PropPart:
        """The part shifted by ``offset``, metres."""
        shift = np.asarray(offset, np.float64)
        pieces = tuple(piece + shift for piece in self.pieces)
        return replace(self, mesh=self.mesh.moved(offset=shift), pieces=pieces)

    def rotated(self, axis: ArrayLike, angle: float, about: ArrayLike = (0, 0, 0)) -> PropPart:
        """The part turned by ``angle`` radians about ``axis`` through the point ``about``."""
        matrix, center = axis_angle_matrix(axis, angle), np.asarray(about, np.float64)
        shift = center - apply(matrix, center)
        pieces = tuple(apply(matrix, piece) + shift for piece in self.pieces)
        return replace(self, mesh=self.mesh.rotated(matrix).moved(offset=shift), pieces=pieces)

    def patched(self, where: Callable[[Points, Points], NDArray[np.bool_]], look: Look) -> PropPart:
        """The part with ``look`` on the triangles whose centres and normals (F, 3) are so."""
        corners = self.mesh.vertices[self.mesh.faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        mask = np.asarray(where(ordered_mean(corners, axis=1), unit(normals)), np.bool_)
        return replace(self, patches=(*self.patches, (mask, look)))


Maker = Callable[[], Iterable[PropPart]]


def prop(name: str, size: Vec3) -> Callable[[Maker], Maker]:
    """Register a builder of parts as the shape ``prop:name``, of a natural ``size`` in metres."""
    NATURAL_SIZES[name] = size

    def add(parts_of: Maker) -> Maker:
        shapes.register(PREFIX + name)(lambda: _fitted(name, list(parts_of())))
        return parts_of

    return add


def _fitted(name: str, parts: list[PropPart]) -> PropShape:
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
    slot = 0 if part.look is None else 1 + own_looks.index(part.look)
    paint = np.full(len(part.mesh.faces), slot, np.int32)
    for mask, look in part.patches:
        paint[mask] = 1 + own_looks.index(look)
    return paint
