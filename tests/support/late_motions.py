"""A real dataset of hand-made motions, rendered: a cube rises or falls only after the observed
part, so that nothing observed tells whether it will touch the other one.

`support.moving_dots` has movies alone; these trials also have motions.
"""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import numpy as np

from physion.clips.batch import Motion
from physion.physics.labels import label_contact
from physion.physics.trajectory import ENVIRONMENT
from physion.rendering.renderer import Renderer, role_map
from physion.scenes.looks import in_look
from physion.trials.dataset import Dataset
from physion.trials.files import Metadata, TrialPaths, encode_png, write_files
from physion.trials.index import build_index, write_index
from physion.trials.trial_file import TrialWriter
from physion.trials.video import encode_movie
from support.crossing_bodies import crossing

FRAMES, SIZE, OBSERVED, SCENARIO = 136, 64, 45, "collide"
HELD = 9
"""Frames for which a picture is shown; RPIN sees every ninth, and the others take time to draw."""


def late_motion(name: str, contact: bool, frames: int = FRAMES) -> Motion:
    """Return a motion in which the agent rises to the patient (contact), or falls.

    In frame 10 the agent touches the floor.
    """
    rng = np.random.default_rng(int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big"))
    last = frames - 1
    motion = crossing(
        name=name, patient=(0.0, 0.6, 1.0), scale=(0.3, 0.3, 0.3), frames=frames,
        touch=[10, last] if contact else [10],
    )  # fmt: skip
    fraction = np.arange(frames) / last
    late = (np.arange(frames) - OBSERVED).clip(0) / (last - OBSERVED)
    height = rng.uniform(0.4, 0.5)
    end = rng.uniform(0.9, 1.1) if contact else rng.uniform(0.0, 0.1)
    positions = motion.trajectory.positions.copy()
    positions[:, 0, 0] = 0.0
    positions[:, 0, 1] = rng.uniform(-0.9, -0.8) + 1.1 * fraction
    positions[:, 0, 2] = height + (end - height) * late
    velocities = np.gradient(positions, 0.01, axis=0).astype(np.float32)
    contacts = motion.trajectory.contacts
    contacts.bodies[0] = (ENVIRONMENT, 0)
    moved = dataclasses.replace(motion.trajectory, positions=positions, velocities=velocities)
    return Motion(motion.scene, moved)


def make_late_motions(folder: Path, counts: dict[str, int], more: int = 0) -> Dataset:
    """Return a dataset with ``counts[split]`` trials, half of them with contact.

    Every trial has ``more`` frames more than the one before.
    """
    for split, count in counts.items():
        for number in range(count):
            _make(folder, split, number, FRAMES + more * number)
    table, problems = build_index(folder)
    assert problems == {}
    write_index(folder, table)
    return Dataset(folder)


def _make(folder: Path, split: str, number: int, count: int) -> None:
    name = f"{SCENARIO}_{split}_{number:04d}"
    motion = late_motion(name, contact=number % 2 == 0, frames=count)
    scene, trajectory = motion.scene, motion.trajectory
    renderer = Renderer(in_look(scene, "redyellow"), trajectory, SIZE, SIZE)
    shown: Any = [renderer.render(frame, ("color",)).color for frame in range(0, count, HELD)]
    frames = np.repeat(np.stack(shown), HELD, axis=0)[:count]
    ids: Any = renderer.render(0, ("ids",)).ids
    metadata = Metadata(
        trial=name, dataset="late-motions", scenario=SCENARIO, split=split, index=number,
        preset=None, seed="00", look="redyellow", width=SIZE, height=SIZE, frames=count,
        observed_frames=OBSERVED, frame_time=0.01, playback_rate=30, completed=True,
        engine=trajectory.engine, renderer="none", package="0", digest=trajectory.digest(),
        scene_digest=scene.physics_digest(),
    )  # fmt: skip
    labels = label_contact(scene, trajectory)
    files = {
        "trial_file": TrialWriter(metadata, scene, trajectory, labels, ids).finish(),
        "movie": encode_movie(frames),
        "observed_movie": encode_movie(frames[:OBSERVED]),
        "map": encode_png(role_map(ids, scene)),
    }
    write_files(TrialPaths(folder, split, SCENARIO, name), files)
