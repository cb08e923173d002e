"""Import of one official HDF5 file: scene, motion, contacts, labels and movies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from physion.errors import BadInputError
from physion.physics.labels import Labels, label_contact
from physion.physics.trajectory import Trajectory
from physion.rendering.renderer import Renderer, role_map
from physion.scenes.scene import OBSERVED_FRAMES, PLAYBACK_RATE, Scene
from physion.trials.files import encode_png, write_files
from physion.trials.official.movies import (
    PICTURES,
    EncodedMovies,
    make_movies,
    read_movie,
    stored_frames,
)
from physion.trials.official.read_hdf5 import OfficialFile
from physion.trials.official.reading.job import ImportJob, imported_metadata
from physion.trials.official.reading.read_motion import MotionReader
from physion.trials.official.reading.read_scene import SceneReader
from physion.trials.official.reading.round_trip import restored_files, stored_trial
from physion.trials.trial_file import TrialWriter

UNSEEN_SIZE = (256, 256)
"""Width and height in pixels of the id map of a trial without pictures."""
_CODE = np.array([1, 256, 65536])
"""Weights that turn a colour into one number."""


def import_state(job: ImportJob) -> tuple[str, ...]:
    """Write the files of the trial in an official HDF5 file; return remarks about guesses."""
    with OfficialFile.open(job.source) as file:
        reader = SceneReader(file, job.paths.trial, job.paths.scenario)
        motion = MotionReader(reader)
        scene, trajectory = motion.scene, motion.trajectory()
        frames = len(trajectory)
        if frames <= OBSERVED_FRAMES:
            raise file.bad(
                "frames", f"holds {frames}; nothing is left to predict after {OBSERVED_FRAMES}"
            )
        stored = stored_trial(motion, trajectory)
        if stored is not None:
            write_files(job.paths, restored_files(job, file, reader.frames, stored))
            return ()
        movies = _movies(job, file, reader, frames)
        ids = _ids(file, reader, scene, trajectory, movies.size if movies else UNSEEN_SIZE)
        labelled = motion.labelled_contact
        labels = _labels(job, scene, trajectory, labelled)
        recorded = job.contact if labelled is None else bool(labelled.any())
        if recorded is not None and recorded != label_contact(scene, trajectory).contact:
            reader.notes.append(
                f"the label of the file is contact {recorded}, but its contacts give the opposite"
            )
        metadata = imported_metadata(
            job,
            scene,
            trajectory,
            ids,
            look="redyellow" if reader.redyellow() else "free",
            movies=movies is not None,
            rate=movies.rate if movies else PLAYBACK_RATE,
            recorded=recorded,
        )
    files: dict[str, bytes] = {}
    if movies:
        files = {"movie": movies.full, "observed_movie": movies.observed}
        files["map"] = encode_png(role_map(ids, scene))
    files["trial_file"] = TrialWriter(metadata, scene, trajectory, labels, ids).finish()
    write_files(job.paths, files)
    return tuple(dict.fromkeys(reader.notes))


def _labels(
    job: ImportJob, scene: Scene, trajectory: Trajectory, labelled: NDArray[np.bool_] | None
) -> Labels:
    """Return the labels stored in the file, else those of metadata.json, else of its contacts."""
    labels = label_contact(scene, trajectory)
    if labelled is None and job.contact is None:
        return labels
    touches = np.flatnonzero(labelled) if labelled is not None else np.zeros(0)
    first = int(touches[0]) if len(touches) else None
    contact = first is not None
    if labelled is None:
        contact, first = bool(job.contact), job.first_frame
    observed = first is not None and first < OBSERVED_FRAMES
    return replace(labels, contact=contact, first_frame=first, observed=observed)


def _movies(
    job: ImportJob, file: OfficialFile, reader: SceneReader, frames: int
) -> EncodedMovies | None:
    """Return the movie next to the file or, if that is damaged, one made from stored pictures."""
    beside = job.source.with_name(f"{job.source.stem}_img.mp4")
    try:
        return read_movie(beside, frames) if beside.is_file() else _stored(file, reader, frames)
    except BadInputError as error:
        if not file.has(f"{reader.frames[0]}/{PICTURES}"):
            raise
        reader.notes.append(f"the pictures in the file replace its movie: {error}")
        return _stored(file, reader, frames)


def _stored(file: OfficialFile, reader: SceneReader, frames: int) -> EncodedMovies | None:
    if not file.has(f"{reader.frames[0]}/{PICTURES}"):
        reader.notes.append("it has no pictures, so there are no movies")
        return None
    pictures = stored_frames(file, reader.frames)
    return make_movies(pictures, frames, PLAYBACK_RATE)


def _ids(
    file: OfficialFile,
    reader: SceneReader,
    scene: Scene,
    trajectory: Trajectory,
    size: tuple[int, int],
) -> NDArray[np.int16]:
    """Return the ids (H, W) of frame 0 from the file's id picture; rendered if it has none.

    ``size`` is (width, height) in pixels.
    """
    path, colors = f"{reader.frames[0]}/images/_id", "static/object_segmentation_colors"
    if file.has(path) and file.has(colors):
        codes = file.picture(path).astype(np.int64) @ _CODE
        rows = file.table(colors, 3)
        if len(rows) == len(reader.ids) and np.isfinite(rows).all():
            ids = np.zeros(codes.shape, np.int16)
            for index in reader.kept:
                color = rows[index].astype(np.int64) @ _CODE
                ids[codes == color] = scene.index(reader.label(index)) + 1
            down, across = (
                (np.arange(wanted) * have) // wanted
                for wanted, have in zip(size[::-1], ids.shape, strict=True)
            )
            return np.asarray(ids[down][:, across])
    reader.notes.append("it has no picture of ids; they are rendered from its state")
    rendered = Renderer(scene, trajectory, *size).render(0, ("ids",)).ids
    assert rendered is not None, "the renderer left out ids"
    return rendered
