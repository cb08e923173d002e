"""Contact of agent and patient as the published evaluation decides it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from physion.models.baselines.motion import FAR
from physion.models.particles.bodies import Poses, SceneParticles
from physion.scenes.scene import Scene

F64 = NDArray[np.float64]

CLOTH_SCALE = 0.05 / 0.035
"""Factor of all coordinates in Drape, whose particles are 0.035 m apart: 0.05 m after it."""
CONTACT = 0.075
"""Metres between particles that count as a contact: 1.5 spacings."""
_CONTACT = {"contain": 0.05, "drop": 0.05, "drape": 0.1222556027835}
"""Metres in the other scenarios; in Drape 0.17465 after `CLOTH_SCALE`."""
_STEPS = {"support": 205, "link": 140, "contain": 125, "collide": 55, "drape": 55}
_OTHER_STEPS, _OBSERVED_STEPS = 105, 15


def contact_distance(scene: Scene) -> float:
    """Return the distance of particles, metres, below which the published code sees a contact."""
    return _CONTACT.get(scene.scenario, CONTACT)


def rollout_steps(scene: Scene) -> int:
    """Return how many steps of 0.03 s the published code imagines."""
    return _STEPS.get(scene.scenario, _OTHER_STEPS) - _OBSERVED_STEPS


def particle_distance(particles: SceneParticles, poses: Poses) -> float:
    """Return the smallest distance of a particle of the agent and one of the patient, metres.

    Of all rows of a motion of loose particles, not between rows; at most `FAR`, also if agent or
    patient is absent.
    """
    if min(particles.agent, particles.patient) < 0:
        return FAR
    owners = particles.owners[particles.loose]
    first, second = (poses.loose[:, owners == row] for row in (particles.agent, particles.patient))
    best = FAR
    for a, b in zip(first, second, strict=True):
        if _box_distance(a, b) < best:
            distances, _ = cKDTree(a).query(b, distance_upper_bound=best)
            best = min(best, float(distances.min()))
    return best


def _box_distance(a: F64, b: F64) -> float:
    """Return the distance of the boxes around two sets of points."""
    apart = np.maximum(a.min(axis=0) - b.max(axis=0), b.min(axis=0) - a.max(axis=0))
    return float(np.sqrt(np.sum(np.maximum(apart, 0.0) ** 2)))
