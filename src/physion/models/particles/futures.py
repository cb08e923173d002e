"""Imagined motions of trials: their start, how near agent and patient come, and what is shown."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from physion.models.anchors.smallest_gap import FAR
from physion.models.batch import LAST_OBSERVED, Motion
from physion.models.observed import cut_to_observed
from physion.models.particles.bodies import (
    CLOTH,
    ParticleSettings,
    Poses,
    SceneParticles,
    join_poses_in_time,
    later_poses,
    particle_positions,
    poses_of,
    put_by_events,
    scene_particles,
)
from physion.models.particles.config import ParticleConfig
from physion.models.particles.gap import smallest_distance
from physion.models.particles.rollout import Start
from physion.physics.labels import label_contact

F64 = NDArray[np.float64]
Futures = list[tuple[SceneParticles, Poses]]
"""Particles and motion of every sample of a trial."""


def observed_start(motion: Motion, frames: range, settings: ParticleSettings) -> Start:
    """Return the observed motion of a scene in these frames, and the steps to its end."""
    scene = motion.scene
    own = scene_particles(scene, settings, scene.present(LAST_OBSERVED))
    poses = poses_of(own, motion, frames)
    # What was put somewhere between the last two steps did not move there.
    put = np.isin(own.things, put_by_events(scene, frames[-2], frames[-1]))
    poses.centers[-2, put], poses.rotations[-2, put] = (
        poses.centers[-1, put],
        poses.rotations[-1, put],
    )
    limit = scene.ending.frame_limits()[1] - 1 - LAST_OBSERVED
    return Start(own, poses, limit // frames.step)


def unseen_outcomes(
    motions: Sequence[Motion],
) -> tuple[list[Motion], NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the trials (n) whose outcome follows the observed part, of whole motions.

    Returns
    -------
    observed : list of Motion
        Their observed parts.
    contact : ndarray
        Whether agent and patient touch (n,).
    cloth : ndarray
        Whether one of them is a cloth (n,).
    """
    observed, contact, cloth = [], [], []
    for motion in motions:
        scene, trajectory = motion.scene, motion.trajectory
        if len(trajectory) <= LAST_OBSERVED:
            continue
        label = label_contact(scene, trajectory)
        if not label.observed:
            observed.append(Motion(scene, cut_to_observed(scene, trajectory)))
            contact.append(label.contact)
            things = [scene.index(name) for name in (scene.roles.agent, scene.roles.patient)]
            cloth.append(max(things) >= len(scene.bodies))
    return observed, np.array(contact, np.bool_), np.array(cloth, np.bool_)


def join_futures(
    observed: Sequence[Start], imagined: Sequence[Poses], samples: int
) -> list[Futures]:
    """Return whole motions of ``samples`` futures of each trial, which follow one another."""
    joined = [
        (start.particles, join_poses_in_time(start.poses, later))
        for start, later in zip(observed, imagined, strict=True)
    ]
    return [joined[row : row + samples] for row in range(0, len(joined), samples)]


def smallest_gaps(
    motions: Sequence[Motion],
    futures: Sequence[Futures],
    config: ParticleConfig,
    *,
    first: int,
    touch: F64,
) -> F64:
    """Return the smallest gaps (B, S) of agent and patient, metres, less ``touch``.

    After a contact that was observed, by the rule of the label, they are -`FAR`, below every
    threshold that a reader can fit.

    Parameters
    ----------
    motions, futures
        Observed motion and futures of each trial.
    config
        Settings of the search for the smallest distance.
    first
        Row of the motions from which they count, that of frame 44.
    touch
        Distances (2,) at which two bodies, and a cloth and a body, touch, metres.
    """
    gaps = np.zeros((len(motions), len(futures[0])))
    for row, (motion, own) in enumerate(zip(motions, futures, strict=True)):
        for column, (particles, poses) in enumerate(own):
            later = later_poses(poses, first)
            distance = smallest_distance(
                motion.scene, particles, later, config.gap_spacing, config.gap_limit
            )
            pair = [particles.agent, particles.patient]
            soft = min(pair) >= 0 and CLOTH in particles.kinds[pair]
            gaps[row, column] = distance - touch[int(soft)]
        if label_contact(motion.scene, motion.trajectory).observed:
            gaps[row] = -FAR
    return gaps


def shown_particles(futures: Sequence[Futures], observed: int) -> dict[str, NDArray[np.generic]]:
    """Return the particles of the frames after the first ``observed`` ones.

    They are ``particles`` (B, S, F, P, 3) in metres and ``things`` (B, P), the index of the object
    of each in `Scene.names`; NaN and -1 where a trial has fewer frames or particles than another.
    """
    clouds = [
        [particle_positions(particles, poses)[observed:] for particles, poses in own]
        for own in futures
    ]
    samples, parts = len(futures[0]), [cloud for own in clouds for cloud in own]
    frames, count = (max(cloud.shape[axis] for cloud in parts) for axis in (0, 1))
    shape = (len(futures), samples, frames, count, 3)
    positions = np.full(shape, np.nan, np.float32)
    things = np.full((len(futures), count), -1, np.int64)
    for row, own in enumerate(clouds):
        particles = futures[row][0][0]
        things[row, : len(particles.owners)] = particles.things[particles.owners]
        for sample, cloud in enumerate(own):
            positions[row, sample, : cloud.shape[0], : cloud.shape[1]] = cloud
    return {"particles": positions, "things": things}
