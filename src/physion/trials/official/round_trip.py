"""Our own trials come back whole from the official files that we wrote.

The official layout has no place for impulses, presets, seeds or how robust a label is, so an export
keeps the trial file itself, without image passes, under ``physion/trial_file``. It is checked as
every trial file is, and believed only where the official arrays of the same file tell the same:
otherwise somebody has changed them, and they alone are read.
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
from physion.trials.official.axes import to_official_camera
from physion.trials.official.job import ImportJob
from physion.trials.official.movies import PICTURES, SourceMovie, beside, make_movies, stored_frames
from physion.trials.official.names import TRIAL_FILE
from physion.trials.official.read_hdf5 import OfficialFile
from physion.trials.official.read_motion import MotionReader
from physion.trials.official.write_objects import OfficialObjects
from physion.trials.trial_file import Metadata, Trial, TrialWriter
from physion.trials.video import MovieEncoder, count_frames

_CLOSE = 1e-5
"""Metres, and what else is compared: what single precision and the other axes may change."""
_BROKEN = (PhysionError, ArithmeticError, LookupError, ValueError)
"""What a trial file that is none, or whose parts do not fit together, may raise."""

Pictures = Iterator[NDArray[np.uint8]]


def stored_trial(motion: MotionReader, trajectory: Trajectory) -> Trial | None:
    """The trial that an official file was written from; None where it has none to be believed.

    ``trajectory`` is what the official arrays tell. Why a trial was not believed is noted.
    """
    file, notes = motion.reader.file, motion.reader.notes
    if not file.has(TRIAL_FILE):
        return None
    try:
        trial = Trial(file.data(TRIAL_FILE), f"{file.where}: field {TRIAL_FILE!r}")
        checks = _checks(trial, motion, trajectory)
        differs = next((name for name, same in checks if not same), None)
    except _BROKEN as error:
        notes.append(f"the trial that is stored in it is damaged and was left out: {error}")
        return None
    if differs is not None:
        notes.append(f"{differs} is not that of the trial stored in it, which was left out")
        return None
    return trial


def _checks(
    trial: Trial, motion: MotionReader, trajectory: Trajectory
) -> Iterator[tuple[str, bool]]:
    """Names of fields and whether they fit the trial; later ones take the earlier for granted."""
    reader, meta, scene, own = motion.reader, trial.metadata, trial.scene, trial.trajectory
    objects = OfficialObjects(trial.shown(), own)
    ids, roles, file = objects.ids, scene.roles, reader.file
    times = (OBSERVED_FRAMES, FRAME_TIME, reader.scenario)
    yield "the scenario", (meta.observed_frames, meta.frame_time, meta.scenario) == times
    origin = {value is None for value in (meta.seed, meta.preset, meta.attempt)}
    yield "the origin", len(origin) == 1
    yield "the digest", (own.digest(), scene.physics_digest()) == (meta.digest, meta.scene_digest)
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
    moves = (reader.motion.velocities, reader.motion.spins)
    for values, kept in zip((*poses, *moves), (*objects.poses, *objects.motions), strict=True):
        yield "the motion", _close(values, kept)
    camera = f"{reader.frames[0]}/camera_matrices/"
    wanted = to_official_camera(scene.camera, meta.width, meta.height)
    for name, matrix in zip(("camera_matrix", "projection_matrix"), wanted, strict=True):
        yield "the camera", _close(file.numbers(camera + name, (16,)), matrix.ravel())
    yield from _contact_checks(trial, motion, trajectory, objects)


def _contact_checks(
    trial: Trial, motion: MotionReader, trajectory: Trajectory, objects: OfficialObjects
) -> Iterator[tuple[str, bool]]:
    reader, scene, own = motion.reader, trial.scene, trial.trajectory
    sheets = sum(cloth.resolution**2 for cloth in scene.cloths)
    yield "the cloth", own.cloth_vertices.shape[1] == sheets
    for place, thing in enumerate(objects.things):
        if isinstance(thing, Cloth):
            seen = [motion.particles(place, frame) for frame in range(len(own))]
            kept = objects.cloth_vertices(objects.order[place])
            yield "the cloth", all(_close(a, b) for a, b in zip(seen, kept, strict=True))
    yield "the cloth's distance", _close(trajectory.cloth_distance, own.cloth_distance)
    names = motion.scene.names()
    theirs = np.full(len(names) + 1, ENVIRONMENT)
    for place in reader.kept:
        theirs[names.index(reader.label(place)) + 1] = place
    ours = np.full(len(objects) + 1, ENVIRONMENT)
    ours[np.array(objects.order) + 1] = np.arange(len(objects))
    rows = _rows(trajectory.contacts, theirs), _rows(own.contacts, ours)
    yield "the list of contacts", _close(*rows)
    yield "labels/trial_complete", trajectory.completed == own.completed
    if motion.said is not None:
        said = np.flatnonzero(motion.said)
        yield "labels/target_contacting_zone", np.array_equal(said, contact_frames(scene, own))
        first = int(said[0]) if len(said) else None
        yield (
            "the label",
            (trial.labels.contact, trial.labels.first_frame) == (bool(len(said)), first),
        )


def _rows(contacts: Contacts, places: NDArray[np.int64]) -> NDArray[np.float64]:
    """Contacts (C, 9) by frame and places of both things: those three, point, normal.

    ``places`` begins with that of the environment.
    """
    pairs = places[contacts.bodies + 1]
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
    """The files of the trial as they were; name, split and dataset are those of the job.

    Under another split or dataset a drawn scene becomes an imported one."""
    kept = trial.metadata
    dataset, split = job.dataset or kept.dataset, job.paths.split
    meta = replace(kept, trial=job.paths.trial, split=split, dataset=dataset)
    if (meta.split, meta.dataset) != (kept.split, kept.dataset):
        # Seeds come from these names: under others the sampler draws another scene.
        meta = replace(meta, seed=None, preset=None, attempt=None)
    files: dict[str, bytes] = {}
    if meta.movies:
        own = job.source.with_name(f"{job.source.stem}_img.mp4")
        drawn = file.has(f"{frames[0]}/{PICTURES}")
        pictures = stored_frames(file, frames) if drawn else _rendered(trial, meta.look)
        files["movie"], files["observed_movie"] = _movies(meta, own, pictures)
        files["map"] = encode_png(role_map(trial.ids, trial.scene))
    if meta.movies and meta.free_movies:
        name = f"{plain_name(job.paths.trial)}_img.mp4"
        path = beside(job.source, "mp4s", name)
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
    """The full movie at ``path`` if it is one of the trial, and what is missing, of ``pictures``.

    The observed part is made of pictures: cut out of a movie it would be packed twice.
    """
    size = (meta.height, meta.width, 3)
    if path is None or not _fits(meta, path):
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


def _fits(meta: Metadata, path: Path) -> bool:
    """Whether a movie can be the trial's own as it is."""
    try:
        movie = SourceMovie(path)
        size = (movie.width, movie.height, movie.rate)
        wanted = (meta.width, meta.height, meta.playback_rate)
        return movie.copied and size == wanted and count_frames(path) == meta.frames
    except BadInputError:
        return False
