"""Import of official movies without HDF5 files, which gives trials without motion.

PhysionTest-Core, the most common download, has movies, maps and labels, but no motion. A trial
imported from it can be used by models that see pictures. Its state is unknown: all poses are NaN,
the two bodies are placeholders called ``agent`` and ``patient``, the engine is
``imported: movie alone``, and the frame of first contact is None unless the metadata.json next to
the movie has it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from physion.errors import BadInputError
from physion.physics.labels import Labels
from physion.physics.trajectory import Contacts, Trajectory
from physion.rendering.renderer import role_map
from physion.scenes.scene import OBSERVED_FRAMES, Body, Camera, Roles, Scene
from physion.stimulus_names import plain_name
from physion.trials.files import encode_png, write_files
from physion.trials.official.movies import neighbouring_file, read_movie
from physion.trials.official.names import decode_picture, redyellow_name
from physion.trials.official.reading.job import ImportJob, imported_metadata
from physion.trials.trial_file import TrialWriter

ENGINE = "imported: movie alone"
NOTE = "no state: bodies are placeholders and poses are unknown"


def import_movie(job: ImportJob) -> tuple[str, ...]:
    """Write the files of a trial from a movie, a map and a label; return what is missing."""
    if job.contact is None:
        raise BadInputError(
            f"no labels.csv or metadata.json near {job.source} has the outcome of "
            f"{job.paths.trial!r}"
        )
    notes = [NOTE]
    free = read_movie(job.source)
    marked = neighbouring_file(
        job.source, "mp4s-redyellow", f"{redyellow_name(job.paths.trial)}_img.mp4"
    )
    own = read_movie(marked, free.frames) if marked is not None else free
    ids = _ids(job, own.size, notes)
    scene, trajectory = _scene(job), _unknown_motion(own.frames)
    first = job.first_frame if job.contact else None
    labels = Labels(job.contact, first, first is not None and first < OBSERVED_FRAMES)
    metadata = imported_metadata(
        job,
        scene,
        trajectory,
        ids,
        look="free" if marked is None else "redyellow",
        movies=True,
        free_movies=marked is not None,
        rate=own.rate,
        recorded=job.contact,
    )
    files = {"movie": own.full, "observed_movie": own.observed}
    if marked is not None:
        files |= {"free_movie": free.full, "free_observed_movie": free.observed}
    files["map"] = encode_png(role_map(ids, scene))
    files["trial_file"] = TrialWriter(metadata, scene, trajectory, labels, ids).finish()
    write_files(job.paths, files)
    return tuple(notes)


def _ids(job: ImportJob, size: tuple[int, int], notes: list[str]) -> NDArray[np.int16]:
    """Return ids (H, W) from the map: 1 where it is red, 2 where it is yellow, else 0."""
    name = f"{plain_name(job.paths.trial)}_map.png"
    path = neighbouring_file(job.source, "maps", name)
    if path is None:
        notes.append("no map: the pixels of agent and patient are unknown")
        return np.zeros(size[::-1], np.int16)
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
        colors = decode_picture(data)
    except BadInputError as error:
        raise BadInputError(f"map {path} is {error}") from error
    if colors.shape[:2] != size[::-1]:
        resized = Image.fromarray(colors).resize(size, Image.Resampling.NEAREST)
        colors = np.asarray(resized)
    red, green, blue = np.moveaxis(colors > 127, -1, 0)
    return np.where(red & ~blue, np.where(green, 2, 1), 0).astype(np.int16)


def _scene(job: ImportJob) -> Scene:
    """Return a scene of two placeholders."""
    return Scene(
        name=job.paths.trial,
        scenario=job.paths.scenario,
        bodies=tuple(Body(name, "cube", (0.0, 0.0, 0.0)) for name in ("agent", "patient")),
        roles=Roles("agent", "patient"),
        camera=Camera((3.0, 0.0, 1.0)),
        room="empty",
        parameters={"source": "official movie", "state": "unknown"},
    )


def _unknown_motion(frames: int) -> Trajectory:
    """Return the motion of two bodies with unknown poses."""
    unknown = np.full((frames, 2, 3), np.nan, np.float32)
    return Trajectory(
        positions=unknown,
        rotations=np.full((frames, 2, 4), np.nan, np.float32),
        velocities=unknown,
        angular_velocities=unknown,
        cloth_vertices=np.zeros((frames, 0, 3), np.float32),
        cloth_distance=np.full(frames, np.nan, np.float32),
        contacts=Contacts.empty(),
        completed=False,
        engine=ENGINE,
    )
