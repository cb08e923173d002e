"""Restoring of original trials from official files that this package exported.

The official layout cannot store impulses, presets, seeds or the robustness of a label, so an export
embeds the trial file itself, without image passes, under ``physion/trial_file``. On import it is
checked like every trial file, and used only if the official arrays of the same file agree with it:
otherwise these were changed after the export, and only they are read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from physion.errors import BadInputError, PhysionError
from physion.physics.labels import contact_frames
from physion.physics.trajectory import ENVIRONMENT, Contacts, Trajectory
from physion.rendering.renderer import role_map
from physion.scenes.scene import FRAME_TIME, OBSERVED_FRAMES, Cloth
from physion.stimulus_names import plain_name
from physion.trials.files import encode_png
from physion.trials.metadata import Metadata
from physion.trials.official.axes import to_official_camera
from physion.trials.official.movies import (
    PICTURES,
    SourceMovie,
    make_movies,
    neighbouring_file,
    stored_frames,
)
from physion.trials.official.names import TRIAL_FILE
from physion.trials.official.read_hdf5 import OfficialFile
from physion.trials.official.reading.job import ImportJob
from physion.trials.official.reading.read_motion import MotionReader
from physion.trials.official.writing.objects import OfficialObjects
from physion.trials.trial_file import Trial, TrialWriter
from physion.trials.video import MovieEncoder, count_frames

_CLOSE = 1e-5
"""Tolerance of comparisons, in metres and other units: rounding to single precision."""
_BROKEN = (PhysionError, ArithmeticError, LookupError, ValueError)
"""Exceptions that a damaged or inconsistent trial file can raise."""

Pictures = Iterator[NDArray[np.uint8]]


def stored_trial(motion: MotionReader, trajectory: Trajectory) -> Trial | None:
    """Return the original trial embedded in an official file.

    None if it is absent, damaged, or contradicts the official arrays, whose motion is
    ``trajectory``; the reason is added to the notes.
    """
    file, notes = motion.reader.file, motion.reader.notes
    if not file.has(TRIAL_FILE):
        return None
    try:
        trial = Trial(file.data(TRIAL_FILE), f"{file.where}: field {TRIAL_FILE!r}")
        checks = _checks(trial, motion, trajectory)
        differs = next((name for name, same in checks if not same), None)
    except _BROKEN as error:
        notes.append(f"the embedded trial is damaged and was ignored: {error}")
        return None
    if differs is not None:
        notes.append(f"{differs} differs from the embedded trial, which was ignored")
        return None
    return trial


def _checks(
    trial: Trial, motion: MotionReader, trajectory: Trajectory
) -> Iterator[tuple[str, bool]]:
    """Yield names of fields and whether they agree with the trial; later checks rely on earlier."""
    reader, meta, scene, stored = motion.reader, trial.metadata, trial.scene, trial.trajectory
    objects = OfficialObjects(trial.shown(), stored)
    ids, roles, file = objects.ids, scene.roles, reader.file
    times = (OBSERVED_FRAMES, FRAME_TIME, reader.scenario)
    yield "the scenario", (meta.observed_frames, meta.frame_time, meta.scenario) == times
    origin = {value is None for value in (meta.seed, meta.preset, meta.attempt)}
    yield "the origin", len(origin) == 1
    yield (
        "the digest",
        (stored.digest(), scene.physics_digest()) == (meta.digest, meta.scene_digest),
    )
    yield "the picture's size", trial.ids.shape == (meta.height, meta.width)
    yield "static/object_ids", reader.ids == list(ids.values())
    yield "static/model_names", reader.models == objects.models
    yield (
        "static/mass",
        _close(file.table("static/mass", 1)[:, 0], [thing.mass for thing in objects.things]),
    )
    yield "static/scale", _close(reader.scales, objects.scales)
    colors = [thing.look.color for thing in objects.things]
    yield "static/color", _close(file.table("static/color", 3), colors)
    asked = {"zone_id": roles.patient, "target_id": roles.agent}
    for key, name in asked.items():
        yield f"static/{key}", file.number(f"static/{key}") == ids[name]
    yield "frames", len(reader.frames) == meta.frames
    poses = (reader.motion.positions, reader.motion.rotations)
    moves = (reader.motion.velocities, reader.motion.angular_velocities)
    for values, expected in zip((*poses, *moves), (*objects.poses, *objects.motions), strict=True):
        yield "the motion", _close(values, expected)
    camera = f"{reader.frames[0]}/camera_matrices/"
    wanted = to_official_camera(scene.camera, meta.width, meta.height)
    for name, matrix in zip(("camera_matrix", "projection_matrix"), wanted, strict=True):
        yield "the camera", _close(file.numbers(camera + name, (16,)), matrix.ravel())
    yield from _contact_checks(trial, motion, trajectory, objects)


def _contact_checks(
    trial: Trial, motion: MotionReader, trajectory: Trajectory, objects: OfficialObjects
) -> Iterator[tuple[str, bool]]:
    reader, scene, stored = motion.reader, trial.scene, trial.trajectory
    sheets = sum(cloth.resolution**2 for cloth in scene.cloths)
    yield "the cloth", stored.cloth_vertices.shape[1] == sheets
    for index, thing in enumerate(objects.things):
        if isinstance(thing, Cloth):
            seen = [motion.particles(index, frame) for frame in range(len(stored))]
            expected = objects.cloth_vertices(objects.order[index])
            yield "the cloth", all(_close(a, b) for a, b in zip(seen, expected, strict=True))
    yield "the cloth's distance", _close(trajectory.cloth_distance, stored.cloth_distance)
    names = motion.scene.names()
    read_indices = np.full(len(names) + 1, ENVIRONMENT)
    for index in reader.kept:
        read_indices[names.index(reader.label(index)) + 1] = index
    stored_indices = np.full(len(objects) + 1, ENVIRONMENT)
    stored_indices[np.array(objects.order) + 1] = np.arange(len(objects))
    rows = _rows(trajectory.contacts, read_indices), _rows(stored.contacts, stored_indices)
    yield "the list of contacts", _close(*rows)
    yield "labels/trial_complete", trajectory.completed == stored.completed
    if motion.labelled_contact is not None:
        labelled = np.flatnonzero(motion.labelled_contact)
        yield (
            "labels/target_contacting_zone",
            np.array_equal(labelled, contact_frames(scene, stored)),
        )
        first = int(labelled[0]) if len(labelled) else None
        yield (
            "the label",
            (trial.labels.contact, trial.labels.first_frame) == (bool(len(labelled)), first),
        )


def _rows(contacts: Contacts, indices: NDArray[np.int64]) -> NDArray[np.float64]:
    """Return contacts as sorted rows (C, 9): frame, indices of both objects, point, normal.

    ``indices`` maps the objects of ``contacts`` to common indices, from the environment (-1) on.
    """
    pairs = indices[contacts.bodies + 1]
    sign = np.where(pairs[:, :1] > pairs[:, 1:], -1.0, 1.0)
    pairs = np.sort(pairs, axis=1)
    rows = np.hstack([contacts.frame[:, None], pairs, contacts.point, sign * contacts.normal])
    return np.asarray(rows[np.lexsort((pairs[:, 1], pairs[:, 0], contacts.frame))], np.float64)


def _close(one: ArrayLike, other: ArrayLike) -> bool:
    a, b = np.asarray(one, np.float64), np.asarray(other, np.float64)
    return a.shape == b.shape and np.allclose(a, b, rtol=1e-6, atol=_CLOSE, equal_nan=True)


def restored_files(
    job: ImportJob, file: OfficialFile, frames: list[str], trial: Trial
) -> dict[str, bytes]:
    """Return the files of an embedded trial, with name, split and dataset of the job.

    If split or dataset differ from the original ones, a sampled scene becomes an imported one.
    """
    original = trial.metadata
    dataset, split = job.dataset or original.dataset, job.paths.split
    meta = replace(original, trial=job.paths.trial, split=split, dataset=dataset)
    if (meta.split, meta.dataset) != (original.split, original.dataset):
        # Seeds are derived from these names; with others, the seed would give another scene.
        meta = replace(meta, seed=None, preset=None, attempt=None)
    files: dict[str, bytes] = {}
    if meta.movies:
        path: Path | None = job.source.with_name(f"{job.source.stem}_img.mp4")
        drawn = file.has(f"{frames[0]}/{PICTURES}")
        pictures = stored_frames(file, frames) if drawn else _rendered(trial, meta.look)
        files["movie"], files["observed_movie"] = _movies(meta, path, pictures)
        files["map"] = encode_png(role_map(trial.ids, trial.scene))
    if meta.movies and meta.free_movies:
        name = f"{plain_name(job.paths.trial)}_img.mp4"
        path = neighbouring_file(job.source, "mp4s", name)
        pictures = _rendered(trial, "free")
        files["free_movie"], files["free_observed_movie"] = _movies(meta, path, pictures)
    writer = TrialWriter(meta, trial.scene, trial.trajectory, trial.labels, trial.ids)
    files["trial_file"] = writer.finish()
    return files


def _rendered(trial: Trial, look: str) -> Iterator[NDArray[np.uint8]]:
    for frame in range(trial.metadata.frames):
        color = trial.render(frame, look=look).color
        assert color is not None, "the renderer left out colour"
        yield color


def _movies(meta: Metadata, path: Path | None, pictures: Pictures) -> tuple[bytes, bytes]:
    """Return the full and the observed movie.

    The full movie is that at ``path`` if it matches the trial, else it is encoded from
    ``pictures``. The observed movie is always encoded from pictures, which gives better quality
    than encoding a decoded movie again.
    """
    size = (meta.height, meta.width, 3)
    if path is None or not _matches(meta, path):
        made = make_movies(pictures, meta.frames, meta.playback_rate)
        if made.size != (meta.width, meta.height):
            raise BadInputError(f"pictures of {made.size} pixels are not those of {meta.trial!r}")
        return made.full, made.observed
    encoder = MovieEncoder(meta.width, meta.height, OBSERVED_FRAMES, rate=meta.playback_rate)
    for picture in islice(pictures, OBSERVED_FRAMES):
        if picture.shape != size:
            raise BadInputError(f"a picture of shape {picture.shape} is not one of {meta.trial!r}")
        encoder.add(picture)
    return path.read_bytes(), encoder.finish()


def _matches(meta: Metadata, path: Path) -> bool:
    """Return whether a movie has the coding, size, rate and length of the trial's movie."""
    try:
        movie = SourceMovie(path)
        size = (movie.width, movie.height, movie.rate)
        wanted = (meta.width, meta.height, meta.playback_rate)
        return movie.copied and size == wanted and count_frames(path) == meta.frames
    except BadInputError:
        return False
