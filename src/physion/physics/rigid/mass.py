"""Mass, centre of mass and inertia of bodies, from their convex pieces of uniform density.

This is the one place where mass properties of bodies are computed: the engine, stored states and
exported push points all use them. Like Unity, it takes them from the pieces that collide, not from
the drawn solid.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.numerics.linear_algebra import (
    apply,
    determinant,
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
    """Return the mass properties of a shape at a scale.

    Stretching by S multiplies volumes by |S|, integrals of x by S |S|, of x x^T by S S^T |S|.
    """
    volume, first, second = _unit_moments(name)
    if volume == 0.0:
        return hull_mass([], mass)
    factors = np.asarray(scale)
    stretched = abs(scale[0] * scale[1] * scale[2])
    return _from_moments(
        volume * stretched,
        first * factors * stretched,
        second * outer(factors, factors) * stretched,
        mass,
    )


@cache
def _unit_moments(name: str) -> tuple[float, F64, F64]:
    """Return the integrals of 1, x and x x^T over all pieces of a shape at unit scale."""
    moments = [hull_moments(hull.corners) for hull in collision_hulls(name, (1.0, 1.0, 1.0))]
    if not moments:
        return 0.0, np.zeros(3), np.zeros((3, 3))
    volumes, firsts, seconds = zip(*moments, strict=True)
    return (
        float(ordered_sum(volumes)),
        ordered_sum(np.array(firsts), axis=0),
        ordered_sum(np.array(seconds), axis=0),
    )


def hull_mass(hulls: list[F64], mass: float) -> MassProperties:
    """Return the mass properties of convex pieces of one density, ``mass`` kg together.

    ``hulls`` are their corners, each (K, 3) in metres. Where pieces overlap, matter counts twice,
    as in Unity. Without pieces, the mass has its centre at the origin and a radius of gyration of
    1 m about every axis.
    """
    if not hulls:
        return MassProperties(mass, np.zeros(3), np.eye(3) * mass)
    volumes, firsts, seconds = zip(*map(hull_moments, hulls), strict=True)
    return _from_moments(
        float(ordered_sum(volumes)),
        ordered_sum(np.array(firsts), axis=0),
        ordered_sum(np.array(seconds), axis=0),
        mass,
    )


def _from_moments(volume: float, first: F64, second: F64, mass: float) -> MassProperties:
    """Return the mass properties of a solid with the integrals of 1, x and x x^T.

    With M = integral of x x^T about the centre of mass over the volume, the inertia is
    mass (tr(M) 1 - M).
    """
    center = first / volume
    moments = second / volume - outer(center, center)
    inertia = mass * (ordered_sum(np.diagonal(moments)) * np.eye(3) - moments)
    return MassProperties(mass, center, inertia)


def hull_moments(corners: F64) -> tuple[float, F64, F64]:
    """Return the integrals of 1, x (3,) and x x^T (3, 3) over a convex hull of corners (K, 3)."""
    # Imported late: what only reads scenes and trials starts faster.
    from scipy.spatial import ConvexHull

    corners = np.asarray(corners, np.float64)
    inside = ordered_mean(corners, axis=0)
    triangles = corners[ConvexHull(corners).simplices] - inside
    # Seen from inside, all triangles turn the same way once those with a negative volume are
    # reversed.
    reverse = determinant(triangles) < 0.0
    triangles[reverse] = triangles[reverse][:, ::-1]
    volume, first, second = solid_moments(triangles)
    shifted = outer(inside, first)
    return (
        volume,
        first + volume * inside,
        second + shifted + shifted.T + volume * outer(inside, inside),
    )
