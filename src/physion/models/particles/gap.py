"""Smallest distance of agent and patient over a motion, between its steps too."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from physion.models.particles.bodies import CLOTH, Poses, SceneParticles
from physion.models.particles.neighbours import gap_over_time
from physion.models.particles.surface import surface_points
from physion.scenes.scene import Scene

F64 = NDArray[np.float64]

FAR = 10.0
"""Largest distance that is reported, metres; also that of a thing that is absent."""


def smallest_distance(
    scene: Scene, particles: SceneParticles, poses: Poses, spacing: float, limit: int
) -> float:
    """Return the smallest distance of agent and patient, metres, at most `FAR`.

    Parameters
    ----------
    scene, particles
        The scene and its particles.
    poses
        Motion over T frames; particles move along straight lines between frames.
    spacing, limit
        Of the particles on the surfaces of agent and patient, by which the distance is measured.
        They may be finer than those that move: poses are known for every point of a body. A cloth
        is measured by its own particles.
    """
    rows = (particles.agent, particles.patient)
    if min(rows) < 0 or not len(poses.centers):
        return FAR
    first, second = (_points(scene, particles, poses, row, spacing, limit) for row in rows)
    distance = gap_over_time(first, second)
    return min(distance, FAR) if np.isfinite(distance) else FAR


def _points(
    scene: Scene, particles: SceneParticles, poses: Poses, row: int, spacing: float, limit: int
) -> F64:
    """Return the points (T, P, 3) of an object."""
    if particles.kinds[row] == CLOTH:
        owners = particles.owners[particles.loose]
        return np.ascontiguousarray(poses.loose[:, owners == row])
    body = scene.bodies[int(particles.things[row])]
    points = surface_points(body.shape, body.scale, spacing, limit) - particles.pivots[row]
    turned = points[None] @ poses.rotations[:, row].transpose(0, 2, 1)
    return np.ascontiguousarray(turned + poses.centers[:, row, None])
