"""The observed part of a motion, for models that are given states instead of pictures."""

from __future__ import annotations

from dataclasses import replace

from physion.errors import BadInputError
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import OBSERVED_FRAMES, Scene


def cut_to_observed(scene: Scene, trajectory: Trajectory) -> Trajectory:
    """The first `OBSERVED_FRAMES` frames and their contacts; nothing tells how it went on.

    `BadInputError` for a trajectory that is shorter.
    """
    if len(trajectory) < OBSERVED_FRAMES:
        raise BadInputError(
            f"trial {scene.name!r} has {len(trajectory)} frames, fewer than the "
            f"{OBSERVED_FRAMES} observed ones"
        )
    contacts = trajectory.contacts
    seen = contacts.frame < OBSERVED_FRAMES
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
            frame=contacts.frame[seen],
            bodies=contacts.bodies[seen],
            point=contacts.point[seen],
            normal=contacts.normal[seen],
            impulse=contacts.impulse[seen],
        ),
        completed=False,
    )
