"""Motions of two bodies without forces, made by hand, so that what must be predicted is known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from physion.clips.batch import Batch, Motion
from physion.physics.trajectory import Contacts, Trajectory
from physion.scenes.scene import Body, Camera, Roles, Scene, Vec3

FRAMES = 60


def crossing(
    *,
    name: str = "crossing",
    agent: Vec3 = (0.0, 0.0, 0.0),
    velocity: Vec3 = (2.0, 0.0, 0.0),
    spin: Vec3 = (0.0, 0.0, 0.0),
    patient: Vec3 = (5.0, 0.0, 0.0),
    shape: str = "cube",
    scale: Vec3 = (1.0, 1.0, 1.0),
    touch: Sequence[int] = (),
    frames: int = FRAMES,
    **more: Any,
) -> Motion:
    """Return a motion in which the agent is at ``agent`` (metres, pivot) in frame 44.

    It has ``velocity`` (m/s) and, for the record, ``spin`` (rad/s); the patient of the same shape
    rests. They touch in the frames ``touch``. ``more`` are fields of the scene.
    """
    bodies = (Body("agent", shape, agent, scale), Body("patient", shape, patient, scale))
    fields: dict[str, Any] = {"roles": Roles("agent", "patient"), "bodies": bodies} | more
    scene = Scene(name=name, scenario="collide", camera=Camera((3.0, 0.0, 1.0)), **fields)
    count, touches = len(scene.bodies), np.array(touch, np.int32)
    positions = np.tile(np.array([b.position for b in scene.bodies]), (frames, 1, 1))
    positions[:, 0] = agent + (np.arange(frames)[:, None] - 44) * 0.01 * np.array(velocity)
    velocities, spins = np.zeros((2, frames, count, 3), np.float32)
    velocities[:, 0], spins[:, 0] = velocity, spin
    rows = len(touches)
    contacts = replace(
        Contacts.empty(),
        frame=touches,
        bodies=np.tile(np.array([[0, 1]], np.int32), (rows, 1)),
        point=np.zeros((rows, 3), np.float32),
        normal=np.zeros((rows, 3), np.float32),
        impulse=np.ones(rows, np.float32),
    )
    vertices = sum(cloth.resolution**2 for cloth in scene.cloths)
    trajectory = Trajectory(
        positions=positions.astype(np.float32),
        rotations=np.tile(np.array([1, 0, 0, 0], np.float32), (frames, count, 1)),
        velocities=velocities,
        angular_velocities=spins,
        cloth_vertices=np.zeros((frames, vertices, 3), np.float32),
        cloth_distance=np.full(frames, np.nan, np.float32),
        contacts=contacts,
        completed=True,
        engine="by hand",
    )
    return Motion(scene, trajectory)


def some_crossings(count: int, seed: int) -> tuple[Batch, np.ndarray]:
    """Return motions of bodies that come near the patient, and whether they would touch it."""
    rng = np.random.default_rng(seed)
    sideways = rng.uniform(-3, 3, count)
    motions = [
        crossing(name=f"crossing_{seed}_{row:04d}", agent=(rng.uniform(-1, 1), float(y), 0.0))
        for row, y in enumerate(sideways)
    ]
    return batch_of(motions), np.abs(sideways) < 1.5


def batch_of(motions: Sequence[Motion], **arrays: Any) -> Batch:
    """Return motions as a batch of one context frame, the last observed one."""
    frames = arrays.pop("frames", np.full((len(motions), 1), 44, np.int64))
    valid = np.ones(frames.shape, np.bool_)
    names = tuple(motion.scene.name for motion in motions)
    return Batch(names, frames, valid, state=tuple(motions), **arrays)


def replace_future(motion: Motion, seed: int = 0) -> Motion:
    """Return the motion with noise and permanent contact after the observed part."""
    rng = np.random.default_rng(seed)
    path = motion.trajectory
    later = np.arange(len(path)) > 44

    def noisy(values: np.ndarray) -> np.ndarray:
        kept = np.array(values)
        kept[later] = rng.normal(size=kept[later].shape)
        return kept

    observed = path.contacts.frame <= 44
    touches = np.flatnonzero(later).astype(np.int32)
    count = len(touches)
    contacts = Contacts(
        np.concatenate([path.contacts.frame[observed], touches]),
        np.concatenate(
            [path.contacts.bodies[observed], np.tile(np.array([[0, 1]], np.int32), (count, 1))]
        ),
        *(
            np.concatenate([values[observed], np.ones((count, *values.shape[1:]), np.float32)])
            for values in (path.contacts.point, path.contacts.normal, path.contacts.impulse)
        ),
    )
    arrays = ("positions", "rotations", "velocities", "angular_velocities", "cloth_vertices")
    return Motion(
        motion.scene,
        replace(
            path,
            contacts=contacts,
            completed=not path.completed,
            cloth_distance=noisy(path.cloth_distance),
            **{name: noisy(getattr(path, name)) for name in arrays},
        ),
    )
