"""Mass, centre of mass and inertia of bodies, from their convex pieces of uniform density.

This is the one place where mass properties of bodies are computed: the engine, stored states and
exported push points all use them. Like Unity, it takes them from the pieces that collide, not from
the drawn solid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import ConvexHull

from physion.numerics.linear_algebra import (
    apply,
    dot,
    multiply,
    ordered_mean,
    ordered_sum,
    outer,
)
from physion.numerics.rotations import rotation_matrices
from physion.physics.rigid.hulls import CACHED_HULLS, collision_hulls
from physion.scenes.scene import Body, Vec3
from physion.scenes.shapes.meshes import solid_moments

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class MassProperties:
    """Mass properties of something rigid.

    ``mass`` in kg, ``center`` (3,) of mass in metres, ``inertia`` (3, 3) about it in kg m².
    """

    mass: float
    center: F64
    inertia: F64

    def moved(self, position: ArrayLike, rotation: ArrayLike) -> MassProperties:
        """Return those of the same thing rotated by a quaternion (4,), then put at ``position``."""
        matrix = rotation_matrices(rotation)
        return MassProperties(
            self.mass,
            np.asarray(position) + apply(matrix, self.center),
            multiply(multiply(matrix, self.inertia), matrix.T),
        )


def merge_masses(parts: list[MassProperties]) -> MassProperties:
    """Return the mass properties of several things held together.

    Inertias add by the parallel axis theorem: I = sum of I_i + m_i (|r_i|² 1 - r_i r_iᵀ), with r_i
    from the common centre to that of part i.
    """
    mass = float(ordered_sum([part.mass for part in parts]))
    center = sum((part.mass * part.center for part in parts), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for part in parts:
        arm = part.center - center
        inertia += part.inertia + part.mass * (dot(arm, arm) * np.eye(3) - outer(arm, arm))
    return MassProperties(mass, center, inertia)


def body_mass(body: Body) -> MassProperties:
    """Return the mass properties of a body in its own frame, scaled; its pose is not applied."""
    return _body_mass(body.shape, body.scale, body.mass)


@lru_cache(maxsize=CACHED_HULLS)
def _body_mass(name: str, scale: Vec3, mass: float) -> MassProperties:
    """Return the mass properties of a shape at a scale."""
    return hull_mass([hull.corners for hull in collision_hulls(name, scale)], mass)


def hull_mass(hulls: list[F64], mass: float) -> MassProperties:
    """Return the mass properties of convex pieces of one density, ``mass`` kg together.

    ``hulls`` are their corners, each (K, 3) in metres. Where pieces overlap, matter counts twice,
    as in Unity. Without pieces, the mass has its centre at the origin and a radius of gyration of
    1 m about every axis.
    """
    if not hulls:
        return MassProperties(mass, np.zeros(3), np.eye(3) * mass)
    whole = merge_masses([_solid(np.asarray(hull)) for hull in hulls])
    factor = mass / whole.mass
    return MassProperties(mass, whole.center, whole.inertia * factor)


def _solid(corners: F64) -> MassProperties:
    """Return the mass properties of a convex hull of density 1, with corners (K, 3).

    With M = integral of x x^T about the centre of mass, the inertia is tr(M) 1 - M.
    """
    inside = ordered_mean(corners, axis=0)
    triangles = corners[ConvexHull(corners).simplices] - inside
    # Seen from inside, all triangles turn the same way once those with a negative volume are
    # reversed.
    reverse = dot(triangles[:, 0], np.cross(triangles[:, 1], triangles[:, 2])) < 0.0
    triangles[reverse] = triangles[reverse][:, ::-1]
    volume, first, second = solid_moments(triangles)
    center = first / volume
    moments = second - volume * outer(center, center)
    inertia = ordered_sum(np.diagonal(moments)) * np.eye(3) - moments
    return MassProperties(volume, inside + center, inertia)
