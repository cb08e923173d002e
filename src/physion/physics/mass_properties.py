"""Mass, centre and inertia of bodies made of convex pieces of one density."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MassProperties:
    """``mass`` in kg, ``center`` (3,) in metres, ``inertia`` (3, 3) about the centre in kg m²."""

    mass: float
    center: Array
    inertia: Array

    def moved(self, position: Array, turn: Array) -> MassProperties:
        """The same thing turned by the quaternion ``turn``, then put at ``position``."""
        w, x, y, z = turn
        rotation = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        return MassProperties(
            self.mass,
            np.asarray(position) + rotation @ self.center,
            rotation @ self.inertia @ rotation.T,
        )


def merge_masses(parts: list[MassProperties]) -> MassProperties:
    """Several things held together as one: masses add, inertias by the parallel axis theorem."""
    mass = sum(part.mass for part in parts)
    center = sum((part.mass * part.center for part in parts), np.zeros(3)) / mass
    inertia = np.zeros((3, 3))
    for part in parts:
        arm = part.center - center
        inertia += part.inertia + part.mass * (arm @ arm * np.eye(3) - np.outer(arm, arm))
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
    inside = corners.mean(axis=0)
    hull = ConvexHull(corners)
    triangles = corners[hull.simplices] - inside
    # The volume of a tetrahedron does not depend on the winding once its sign is dropped, and all
    # are positive because the apex lies inside.
    volumes = np.abs(np.linalg.det(triangles)) / 6.0
    volume = volumes.sum()
    centers = triangles.sum(axis=1) / 4.0
    center = volumes @ centers / volume
    # Second moments of a tetrahedron with one corner at the origin.
    sums = triangles.sum(axis=1)
    second = np.einsum("tki,tkj->tij", triangles, triangles) + np.einsum("ti,tj->tij", sums, sums)
    moments = np.einsum("t,tij->ij", volumes, second) / 20.0
    moments -= volume * np.outer(center, center)
    inertia = np.trace(moments) * np.eye(3) - moments
    return MassProperties(float(volume), inside + center, inertia)
