"""Mass, centre and inertia of bodies made of convex pieces of one density."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

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

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MassProperties:
    """``mass`` in kg, ``center`` (3,) in metres, ``inertia`` (3, 3) about the centre in kg m²."""

    mass: float
    center: Array
    inertia: Array

    def moved(self, position: Array, turn: Array) -> MassProperties:
        """The same thing turned by the quaternion ``turn``, then put at ``position``."""
        rotation = rotation_matrices(turn)
        return MassProperties(
            self.mass,
            np.asarray(position) + apply(rotation, self.center),
            multiply(multiply(rotation, self.inertia), rotation.T),
        )


def merge_masses(parts: list[MassProperties]) -> MassProperties:
    """Several things held together as one: masses add, inertias by the parallel axis theorem."""
    mass = sum(part.mass for part in parts)
    center = sum((part.mass * part.center for part in parts), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for part in parts:
        arm = part.center - center
        inertia += part.inertia + part.mass * (dot(arm, arm) * np.eye(3) - outer(arm, arm))
    return MassProperties(mass, center, inertia)


def hull_mass(hulls: list[Array], mass: float) -> MassProperties:
    """Convex pieces with corners ``hulls`` and one density, ``mass`` kg together.

    Where pieces overlap, matter counts twice, as it does in Unity. Without pieces: a point.
    """
    if not hulls:
        return MassProperties(mass, np.zeros(3), np.eye(3) * mass)
    whole = merge_masses([_solid(np.asarray(hull)) for hull in hulls])
    factor = mass / whole.mass
    return MassProperties(mass, whole.center, whole.inertia * factor)


def _solid(corners: Array) -> MassProperties:
    """A convex hull of density 1, as a sum of tetrahedra from a point inside."""
    inside = ordered_mean(corners, axis=0)
    hull = ConvexHull(corners)
    triangles = corners[hull.simplices] - inside
    # The volume of a tetrahedron does not depend on the winding once its sign is dropped, and all
    # are positive because the apex lies inside.
    volumes = np.abs(determinant(triangles)) / 6.0
    volume = ordered_sum(volumes)
    sums = ordered_sum(triangles, axis=1)
    center = ordered_sum(volumes[:, None] * sums / 4.0, axis=0) / volume
    # Second moments of a tetrahedron with one corner at the origin.
    second = ordered_sum(outer(triangles, triangles), axis=1) + outer(sums, sums)
    moments = ordered_sum(volumes[:, None, None] * second, axis=0) / 20.0
    moments -= volume * outer(center, center)
    inertia = ordered_sum(np.diagonal(moments)) * np.eye(3) - moments
    return MassProperties(float(volume), inside + center, inertia)
