"""Making of one trial: choose a scene, simulate, label, render and write it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from physion.core.errors import BadInputError
from physion.core.version import __version__, version_digest
from physion.physics.engine import make_engine
from physion.physics.labels import Labels, label_contact
from physion.physics.trajectory import Trajectory
from physion.rendering.renderer import PASSES, Frame, Renderer, role_map
from physion.rendering.renderer import VERSION as RENDERER_VERSION
from physion.scenes.looks import in_look
from physion.scenes.sampling.sample import get_preset, sample_scene
from physion.scenes.scene import FRAME_TIME, OBSERVED_FRAMES, Scene
from physion.trials.files import Metadata, TrialPaths, encode_png, write_files
from physion.trials.making.choose import choose
from physion.trials.making.pairs import motion_of
from physion.trials.making.plan import PAIR, GenerateJob, TrialTask
from physion.trials.trial_file import Trial, TrialWriter
from physion.trials.video import MovieEncoder, read_chosen

RENDERER = (
    f"physion-{RENDERER_VERSION}.{version_digest(*PASSES)}, "
    f"av {version('av')}, pillow {version('pillow')}"
)
"""Version of the renderer, with the digest of the golden pictures, and of the libraries that encode
movies and maps; stored with every trial."""


def make_trial(job: GenerateJob) -> str:
    """Choose the scene of a trial, make its files, and return its name. A pure function of the job.

    The trial file is written last, so a trial with a trial file is complete.
    """
    task, scene = choose(job) if job.task.presets else (job.task, scene_of(job.task))
    job = dataclasses.replace(job, task=task)
    trajectory = motion_of(scene, make_engine(job.settings.engine))
    if len(trajectory) <= OBSERVED_FRAMES:
        raise BadInputError(
            f"trial {task.trial!r} has {len(trajectory)} frames; nothing is left to predict after "
            f"the {OBSERVED_FRAMES} observed ones"
        )
    labels = None
    if job.labelled:
        labels = dataclasses.replace(label_contact(scene, trajectory), robust=task.robust)
    write_files(job.paths, _files(job, scene, trajectory, labels))
    return task.trial


def scene_of(task: TrialTask) -> Scene:
    """Return the scene of a task in its free colours: the imported or the sampled one."""
    if task.scene is not None:
        return task.scene
    params = None if task.preset is None else get_preset(task.scenario, task.preset).params
    scene = sample_scene(task.scenario, task.seed(), params)
    return dataclasses.replace(scene, name=task.trial)


def _files(
    job: GenerateJob, scene: Scene, trajectory: Trajectory, labels: Labels | None
) -> dict[str, bytes]:
    """Return the bytes of the trial's files; each frame is rendered once per look."""
    settings = job.settings
    size = settings.width, settings.height
    renderer = Renderer(in_look(scene, job.looks[0]), trajectory, *size)
    ids = _image(renderer.render(0, ("ids",)), "ids")
    writer = TrialWriter(
        _metadata(job, scene, trajectory),
        scene,
        trajectory,
        labels,
        ids,
        passes=settings.passes,
        compatible=settings.compatible,
    )
    files = {}
    if settings.movies:
        rate = settings.playback_rate
        if job.labelled:
            files["map"] = encode_png(role_map(ids, scene))
        files["movie"], files["observed_movie"] = make_movies(
            renderer, rate, writer if settings.passes else None
        )
        for look in job.looks[1:]:
            other = Renderer(in_look(scene, look), trajectory, *size)
            files[f"{look}_movie"], files[f"{look}_observed_movie"] = make_movies(other, rate)
    return {**files, "trial_file": writer.finish()}


def make_movies(
    renderer: Renderer, rate: int, writer: TrialWriter | None = None
) -> tuple[bytes, bytes]:
    """Render and encode the full and the observed movie at ``rate`` frames per second.

    If ``writer`` is given, the image passes that it stores are added to it frame by frame.
    """
    frames = len(renderer.trajectory)
    movie, observed = (
        MovieEncoder(
            renderer.width,
            renderer.height,
            count,
            rate=rate,
            causal=PAIR in renderer.scene.parameters,
        )
        for count in (frames, OBSERVED_FRAMES)
    )
    kept = writer.passes if writer else ()
    for index in range(frames):
        frame = renderer.render(index, tuple(dict.fromkeys(("color", *kept))))
        color = _image(frame, "color")
        picture = movie.add(color)
        if index < OBSERVED_FRAMES:
            observed.add(picture)
        if writer:
            writer.add_frame({name: _image(frame, name) for name in kept})
    return movie.finish(), observed.finish()


def _image(frame: Frame, name: str) -> NDArray[Any]:
    image = getattr(frame, name)
    assert isinstance(image, np.ndarray), f"the renderer left out {name}"
    return image


def _metadata(job: GenerateJob, scene: Scene, trajectory: Trajectory) -> Metadata:
    task, settings = job.task, job.settings
    sampled = task.scene is None
    return Metadata(
        trial=task.trial,
        dataset=task.dataset,
        scenario=task.scenario,
        split=task.split,
        index=task.index,
        preset=get_preset(task.scenario, task.preset).name if task.preset else None,
        seed=f"{task.seed().entropy:x}" if sampled else None,
        attempt=task.attempt if sampled else None,
        scene_digest=scene.physics_digest(),
        look=job.looks[0],
        movies=settings.movies,
        free_movies=settings.movies and len(job.looks) > 1,
        width=settings.width,
        height=settings.height,
        frames=len(trajectory),
        observed_frames=OBSERVED_FRAMES,
        frame_time=FRAME_TIME,
        playback_rate=settings.playback_rate,
        completed=bool(trajectory.completed),
        engine=trajectory.engine,
        renderer=RENDERER,
        package=f"physion {__version__}",
        digest=trajectory.digest(),
        recorded_contact=task.recorded_contact,
    )


# Comparison of a few frames of a trial's movies with the rendered state.
#
# It finds a movie that is whole and listed, but belongs to another trial.

CELL = 8
"""Side in pixels of the cells whose mean colours are compared."""
SCALE = 2
"""The state is rendered with so many times fewer pixels a side, which takes less time and tells
trials apart as well."""
LARGEST_DIFFERENCE = 40.0
"""Largest difference of a cell's mean colour between movie and rendered state, of 255. Compression
and the smaller pictures change cells by up to 22 (72 trials of all scenarios, 64, 128 and 256
pixels); the movie of another trial of the same scenario differs by 57 or more somewhere (144
pairs)."""


def foreign_movies(paths: TrialPaths, trial: Trial) -> list[str]:
    """Return one line for each movie of the trial that does not show its state.

    Compared are the first frame, the last one of the observed part, and the last one.
    """
    meta = trial.metadata
    if not meta.movies or not np.isfinite(trial.trajectory.positions).all():
        return []
    observed = [0, meta.observed_frames - 1]
    files = paths.all(meta.movies, meta.free_movies, maps=False)
    faults = []
    for look, prefix in ((meta.look, ""), *((("free", "free_"),) if meta.free_movies else ())):
        rendered = _rendered(trial, look, [*observed, meta.frames - 1])
        faults += _differing(files[f"{prefix}movie"], rendered)
        shown = {frame: rendered[frame] for frame in observed}
        faults += _differing(files[f"{prefix}observed_movie"], shown)
    return faults


def _rendered(trial: Trial, look: str, frames: list[int]) -> dict[int, NDArray[np.float32]]:
    """Return the mean colours (rows, columns, 3) of the cells of rendered frames."""
    meta = trial.metadata
    renderer = trial.renderer(max(meta.width // SCALE, 1), max(meta.height // SCALE, 1), look)
    found = {}
    for frame in frames:
        color = renderer.render(frame).color
        assert color is not None, "colour was asked for"
        found[frame] = _cells(color, CELL // SCALE)
    return found


def _differing(path: Path, rendered: Mapping[int, NDArray[np.float32]]) -> list[str]:
    pictures = read_chosen(path, list(rendered))
    for picture, (frame, wanted) in zip(pictures, rendered.items(), strict=True):
        found = _cells(picture, CELL)
        if found.shape != wanted.shape:
            return [f"{path} has pictures of another size than its trial"]
        if np.abs(found - wanted).max() > LARGEST_DIFFERENCE:
            return [f"{path} does not show its trial: frame {frame} differs from the stored state"]
    return []


def _cells(picture: NDArray[np.uint8], side: int) -> NDArray[np.float32]:
    """Return the mean colours of cells of ``side`` pixels; a rest at the edges is left out."""
    rows, columns = (max(length // side, 1) for length in picture.shape[:2])
    whole = picture[: rows * side, : columns * side]
    height, width = whole.shape[0] // rows, whole.shape[1] // columns
    strips = whole.reshape(rows, height, -1).sum(axis=1, dtype=np.float32)
    sums = strips.reshape(rows, columns, width, 3).sum(axis=2)
    return np.asarray(sums / (height * width), np.float32)
