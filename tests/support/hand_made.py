"""A small hand-made trial, so that storage is tested without engine and renderer."""

from __future__ import annotations

import dataclasses
import hashlib
import os
import signal
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.physics.labels import Labels, label_contact
from physion.physics.trajectory import Contacts, Trajectory
from physion.scenes.scene import Body, Camera, Cloth, Roles, Scene
from physion.trials.files import Metadata, encode_png, write_files
from physion.trials.making.plan import GenerateJob
from physion.trials.trial_file import TrialWriter
from physion.trials.video import encode_movie

FRAMES, SIZE = 60, 32


class Parts(NamedTuple):
    """What goes into a trial file."""

    metadata: Metadata
    scene: Scene
    trajectory: Trajectory
    labels: Labels
    ids: NDArray[np.int16]

    def pack(self, **options: Any) -> bytes:
        """The bytes of the trial file."""
        writer = TrialWriter(*self, passes=sorted(images(0)) if options.pop("full", 0) else ())
        if writer._passes:
            for frame in range(FRAMES):
                writer.add_frame(images(frame))
        return writer.finish()


def images(frame: int) -> dict[str, NDArray[Any]]:
    """One frame of every image pass, different in every frame."""
    rng = np.random.default_rng(frame)
    return {
        "color": rng.integers(0, 255, (SIZE, SIZE, 3), dtype=np.uint8),
        "depth": rng.uniform(1, 9, (SIZE, SIZE)).astype(np.float32),
        "normals": rng.uniform(-1, 1, (SIZE, SIZE, 3)).astype(np.float16),
        "ids": rng.integers(0, 4, (SIZE, SIZE)).astype(np.int16),
        "flow": rng.normal(size=(SIZE, SIZE, 2)).astype(np.float16),
    }


def make_scene(name: str = "tiny", cloth: bool = True) -> Scene:
    """A ball that falls on a box; with a cloth that hangs in the air, if wanted."""
    return Scene(
        name=name,
        scenario="drop",
        bodies=(
            Body("ball", "sphere", (0.0, 0.0, 1.0)),
            Body("box", "cube", (0.0, 0.0, 0.0), mass=2.5),
        ),
        cloths=(Cloth("sheet", (0.0, 0.0, 2.0), resolution=3),) if cloth else (),
        roles=Roles("ball", "box"),
        camera=Camera((3.0, 0.0, 1.0)),
        parameters={"height": 1.0, "list": [1, 2, "drei: ü"], "none": None},
    )


def make_trajectory(scene: Scene, contact_frame: int | None = 50) -> Trajectory:
    """A fall that touches the box from ``contact_frame`` on."""
    rng = np.random.default_rng(1)
    bodies, vertices = len(scene.bodies), sum(c.resolution**2 for c in scene.cloths)
    touches = [] if contact_frame is None else list(range(contact_frame, FRAMES))
    count = len(touches)
    return Trajectory(
        positions=rng.normal(size=(FRAMES, bodies, 3)).astype(np.float32),
        rotations=rng.normal(size=(FRAMES, bodies, 4)).astype(np.float32),
        velocities=rng.normal(size=(FRAMES, bodies, 3)).astype(np.float32),
        angular_velocities=rng.normal(size=(FRAMES, bodies, 3)).astype(np.float32),
        cloth_vertices=rng.normal(size=(FRAMES, vertices, 3)).astype(np.float32),
        cloth_distance=np.full(FRAMES, np.nan, np.float32),
        contacts=Contacts(
            np.array(touches, np.int32).reshape(count),
            np.tile(np.array([[0, 1]], np.int32), (count, 1)),
            rng.normal(size=(count, 3)).astype(np.float32),
            rng.normal(size=(count, 3)).astype(np.float32),
            rng.uniform(size=count).astype(np.float32),
        ),
        completed=True,
        engine="by hand 1",
    )


def make_parts(name: str = "tiny", *, cloth: bool = True, contact_frame: int | None = 50) -> Parts:
    """Everything of a trial, consistent with itself."""
    scene = make_scene(name, cloth)
    trajectory = make_trajectory(scene, contact_frame)
    ids = np.zeros((SIZE, SIZE), np.int16)
    ids[:8, :8], ids[8:24, :] = 1, 2
    metadata = Metadata(
        trial=name,
        dataset="tests",
        scenario=scene.scenario,
        split="testing",
        index=0,
        preset=None,
        seed=None,
        look="free",
        width=SIZE,
        height=SIZE,
        frames=FRAMES,
        observed_frames=45,
        frame_time=0.01,
        playback_rate=30,
        completed=True,
        engine=trajectory.engine,
        renderer="none",
        package="0",
        scene_digest=scene.physics_digest(),
        digest=trajectory.digest(),
    )
    return Parts(metadata, scene, trajectory, label_contact(scene, trajectory), ids)


def write_trial(path: Path, *parts: Any, compatible: bool = False) -> None:
    """Write a trial file from metadata, scene, trajectory, labels and ids."""
    path.write_bytes(TrialWriter(*parts, compatible=compatible).finish())


def make_by_hand(job: GenerateJob) -> str:
    """Write a trial without engine and renderer; what happens depends on the trial's name.

    ``*bad*`` fails, ``*die*`` kills its process.
    """
    name = job.task.trial
    if "bad" in name:
        raise BadInputError(f"{name} cannot be made")
    if "die" in name:
        os.kill(os.getpid(), signal.SIGKILL)
    parts = make_parts(name, contact_frame=50 if job.task.index % 2 else None)
    both = len(job.looks) > 1
    split = dataclasses.replace(
        parts.metadata, split=job.task.split, index=job.task.index, free_movies=both
    )
    color = np.stack([images(frame)["color"] for frame in range(FRAMES)])
    files = {
        "movie": encode_movie(color),
        "observed_movie": encode_movie(color[:45]),
        "map": encode_png(np.zeros((SIZE, SIZE, 4), np.uint8)),
        "trial_file": parts._replace(metadata=split).pack(),
    }
    if both:
        files |= {f"free_{kind}": files[kind] for kind in ("movie", "observed_movie")}
    write_files(job.paths, files)
    return name


def tree_digest(folder: Path) -> str:
    """SHA-256 of the names and bytes of all files under a folder."""
    sha = hashlib.sha256()
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        sha.update(f"{path.relative_to(folder)} {path.stat().st_size}\n".encode())
        sha.update(path.read_bytes())
    return sha.hexdigest()
