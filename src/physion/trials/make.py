"""One trial: from its task to its four files."""

from __future__ import annotations

import dataclasses
from importlib.metadata import version
from typing import Any

import numpy as np
from numpy.typing import NDArray

import physion
from physion.errors import BadInputError, UnknownNameError
from physion.physics.engine import simulate
from physion.physics.labels import Labels, label_contact
from physion.physics.trajectory import Trajectory
from physion.rendering.renderer import Frame, Renderer, role_map
from physion.scenes.looks import with_role_colors
from physion.scenes.scenarios import sample_scene
from physion.scenes.scene import FRAME_TIME, OBSERVED_FRAMES, PLAYBACK_RATE, Scene
from physion.trials.files import encode_png, write_files
from physion.trials.plan import Job, Task
from physion.trials.trial_file import Metadata, TrialWriter
from physion.trials.video import MovieEncoder


def make_trial(job: Job) -> str:
    """Make one trial and write its four files; its name. A pure function of the job.

    The trial file comes last, so that a trial with a trial file is complete.
    """
    task, settings = job.task, job.settings
    scene = scene_of(task, settings.look)
    trajectory = simulate(scene)
    if len(trajectory) <= OBSERVED_FRAMES:
        raise BadInputError(
            f"trial {task.trial!r} has {len(trajectory)} frames; nothing is left to predict after "
            f"the {OBSERVED_FRAMES} observed ones"
        )
    labels = label_contact(scene, trajectory)
    renderer = Renderer(scene, trajectory, settings.width, settings.height)
    files = _render(job, scene, trajectory, labels, renderer)
    write_files(job.paths, files)
    return task.trial


def scene_of(task: Task, look: str) -> Scene:
    """The scene of a task in its final colours: the imported one, or one drawn by its seed."""
    scene = task.scene
    if scene is None:
        if task.preset is not None:
            raise UnknownNameError("preset", task.preset, ())
        scene = sample_scene(task.scenario, task.seed())
        scene = dataclasses.replace(scene, name=task.trial)
    return with_role_colors(scene) if look == "redyellow" else scene


def _render(
    job: Job, scene: Scene, trajectory: Trajectory, labels: Labels, renderer: Renderer
) -> dict[str, bytes]:
    """The bytes of the four files, each frame being rendered once."""
    settings, frames = job.settings, len(trajectory)
    movie = MovieEncoder(settings.width, settings.height, frames)
    observed = MovieEncoder(settings.width, settings.height, OBSERVED_FRAMES)
    first = renderer.render(0, ("ids",))
    ids = _image(first, "ids")
    metadata = _metadata(job, trajectory)
    writer = TrialWriter(
        metadata,
        scene,
        trajectory,
        labels,
        ids,
        passes=settings.passes,
        compatible=settings.compatible,
    )
    passes = tuple(dict.fromkeys(("color", *settings.passes)))
    for index in range(frames):
        frame = renderer.render(index, passes)
        color = _image(frame, "color")
        movie.add(color)
        if index < OBSERVED_FRAMES:
            observed.add(color)
        if settings.passes:
            writer.add_frame({name: _image(frame, name) for name in settings.passes})
    return {
        "movie": movie.finish(),
        "observed_movie": observed.finish(),
        "map": encode_png(role_map(ids, scene)),
        "trial_file": writer.finish(),
    }


def _image(frame: Frame, name: str) -> NDArray[Any]:
    image = getattr(frame, name)
    assert isinstance(image, np.ndarray), f"the renderer left out {name}"
    return image


def _metadata(job: Job, trajectory: Trajectory) -> Metadata:
    task, settings = job.task, job.settings
    sampled = task.scene is None
    return Metadata(
        trial=task.trial,
        dataset=task.dataset,
        scenario=task.scenario,
        split=task.split,
        index=task.index,
        preset=task.preset,
        seed=f"{task.seed().entropy:x}" if sampled else None,
        look=settings.look,
        width=settings.width,
        height=settings.height,
        frames=len(trajectory),
        observed_frames=OBSERVED_FRAMES,
        frame_time=FRAME_TIME,
        playback_rate=PLAYBACK_RATE,
        completed=bool(trajectory.completed),
        engine=trajectory.engine,
        renderer=f"physion {physion.__version__}, numba {version('numba')}",
        package=f"physion {physion.__version__}",
        digest=trajectory.digest(),
        recorded_contact=task.recorded_contact,
    )
