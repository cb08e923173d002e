"""The convex pieces that a body collides with, as corner points.

The official simulator collides hulls of meshes throughout, balls and cylinders included; a hull
rolls and rubs unlike a smooth ball, so ours are hulls as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from physion.physics.rigid.manifold import hull_faces
from physion.scenes.scene import Vec3
from physion.scenes.shapes.primitives import ConvexPiece, ball_mesh, shape

Array = NDArray[np.float64]
Index = NDArray[np.int64]

BALL_SEGMENTS = 16
"""Meridians of a ball's hull, with half as many bands. PhysX allows 255 corners; with 24 balls roll
on for longer than the recorded trials last, with 12 they stop too soon."""


@dataclass(frozen=True, eq=False)
class Hull:
    """A convex piece: ``corners`` (K, 3) in metres, and the corner numbers round each face."""

    corners: Array
    faces: tuple[Index, ...]


def collision_hulls(name: str, scale: Vec3) -> list[Hull]:
    """Every convex piece of the shape called ``name``, scaled, about its pivot."""
    return [Hull(hull.corners * np.asarray(scale), hull.faces) for hull in _unit_hulls(name)]


@cache
def _unit_hulls(name: str) -> tuple[Hull, ...]:
    corners = [_corners(piece) for piece in shape(name).pieces]
    return tuple(Hull(points, tuple(hull_faces(points))) for points in corners)


def _corners(piece: ConvexPiece) -> Array:
    if piece.kind == "convex":
        return piece.vertices
    if piece.kind == "sphere":
        return ball_mesh(piece.half[0], BALL_SEGMENTS).moved(offset=piece.center).vertices
    return piece.mesh.vertices
