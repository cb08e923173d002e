"""Convex hulls that stand for a body in collisions.

The official simulator uses hulls of meshes for all shapes, balls and cylinders included. A hull
rolls and slides unlike a smooth ball, so ours are hulls as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from physion.physics.rigid.manifold import hull_faces
from physion.scenes.scene import Vec3
from physion.scenes.shapes.primitives import ConvexPiece, ball_mesh, shape

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

BALL_SEGMENTS = 16
"""Meridians of a ball's hull, with half as many bands. With 24, balls roll on for longer than in
the recorded trials; with 12 they stop too soon. (PhysX allows 255 corners.)"""


@dataclass(frozen=True, eq=False)
class Hull:
    """Convex hull: ``corners`` (K, 3) in metres, and for each face its corner numbers in order."""

    corners: F64
    faces: tuple[I64, ...]


def collision_hulls(name: str, scale: Vec3) -> list[Hull]:
    """Return the hulls of all convex pieces of the shape ``name``, scaled, in the body's frame."""
    return [Hull(hull.corners * np.asarray(scale), hull.faces) for hull in _unit_hulls(name)]


@cache
def _unit_hulls(name: str) -> tuple[Hull, ...]:
    """Return the hulls of a shape at unit scale."""
    corners = [_corners(piece) for piece in shape(name).pieces]
    return tuple(Hull(points, tuple(hull_faces(points))) for points in corners)


def _corners(piece: ConvexPiece) -> F64:
    """Return the corners (K, 3) of a piece at unit scale."""
    if piece.kind == "convex":
        return piece.vertices
    if piece.kind == "sphere":
        return ball_mesh(piece.half[0], BALL_SEGMENTS).moved(offset=piece.center).vertices
    return piece.mesh.vertices
