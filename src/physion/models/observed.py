"""Observed part of a trajectory, for models that receive states instead of images."""

from __future__ import annotations

from dataclasses import replace

from physion.errors import BadInputError
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import OBSERVED_FRAMES, Scene


def cut_to_observed(scene: Scene, trajectory: Trajectory) -> Trajectory:
    """Return the first `OBSERVED_FRAMES` frames of a trajectory and their contacts.

    Raises `BadInputError` for a shorter trajectory.
    """
    if len(trajectory) < OBSERVED_FRAMES:
        raise BadInputError(
            f"trial {scene.name!r} has {len(trajectory)} frames, fewer than the "
            f"{OBSERVED_FRAMES} observed ones"
        )
    contacts = trajectory.contacts
    observed = contacts.frame < OBSERVED_FRAMES
    return replace(
        trajectory,
        positions=trajectory.positions[:OBSERVED_FRAMES],
        rotations=trajectory.rotations[:OBSERVED_FRAMES],
        velocities=trajectory.velocities[:OBSERVED_FRAMES],
        angular_velocities=trajectory.angular_velocities[:OBSERVED_FRAMES],
        cloth_vertices=trajectory.cloth_vertices[:OBSERVED_FRAMES],
        cloth_distance=trajectory.cloth_distance[:OBSERVED_FRAMES],
        contacts=replace(
            contacts,
            frame=contacts.frame[observed],
            bodies=contacts.bodies[observed],
            point=contacts.point[observed],
            normal=contacts.normal[observed],
            impulse=contacts.impulse[observed],
        ),
        completed=False,
    )
