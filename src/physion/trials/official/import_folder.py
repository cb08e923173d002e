"""Import of folders of official files into a dataset.

Two kinds of folders are read, at any depth and mixed:

- HDF5 files, as written by the generator (``<config>/0007.hdf5`` next to ``0007_img.mp4`` and
  ``metadata.json``) or as published (``hdf5s/<stimulus>.hdf5``): scene, motion, contacts, labels
  and camera. Movies are those next to the file, or are made from the pictures in it.
- Movies without HDF5 files, as in PhysionTest-Core (``mp4s/<stimulus>_img.mp4`` with ``maps``,
  ``mp4s-redyellow`` and ``labels.csv``) or in the folder of a configuration: movies, map and label.
  They have no motion: all poses are NaN.

Both are read as version 1.5 has them, too: HDF5 files whose names end with ``_cam0`` and whose
frames count from 1, and ``physion_mp4s/train`` and ``test`` with ``all_video_labels.json``.

Versions with red agent and yellow patient keep ``-redyellow`` in their names.
"""

from __future__ import annotations

import csv
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from physion.compute.run_tasks import RunReport, run_tasks
from physion.compute.tasks import Executor, Progress
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import digest_of, folder_for_writing, remove_leftovers
from physion.core.names import FOLDERS, guess_scenario, plain_name
from physion.core.settings import parse_json
from physion.core.version import __version__
from physion.physics.labels import Labels, label_contact
from physion.physics.trajectory import Contacts, Trajectory
from physion.rendering.renderer import Renderer, role_map
from physion.scenes.scene import (
    FRAME_TIME,
    OBSERVED_FRAMES,
    PLAYBACK_RATE,
    Body,
    Camera,
    Roles,
    Scene,
)
from physion.trials.files import (
    INDEX,
    MOVIE_ALONE,
    SAFE_NAME,
    SETTINGS,
    Metadata,
    TrialPaths,
    encode_png,
    write_files,
)
from physion.trials.index import build_index, write_index
from physion.trials.making.plan import SPLITS
from physion.trials.official.movies import (
    PICTURES,
    EncodedMovies,
    make_movies,
    neighbouring_file,
    read_movie,
    stored_frames,
)
from physion.trials.official.names import (
    EVALUATOR_LABELS,
    EVALUATOR_SPLITS,
    decode_picture,
    redyellow_name,
    split_name,
)
from physion.trials.official.read_file import MotionReader, OfficialFile, SceneReader
from physion.trials.trial_file import TrialWriter

IMPORTED = "imported"
"""Default name of an imported dataset."""


@dataclass(frozen=True)
class ImportJob:
    """One official trial to import.

    - ``source``: the HDF5 file of the trial, or its movie if there is no HDF5 file.
    - ``paths``: files to write; they hold the trial's name, scenario and split.
    - ``index``: position of the trial in its split and scenario, from 0.
    - ``dataset``: name of the dataset.
    - ``contact``: recorded outcome from the lists next to the source; None if they do not hold it.
    - ``first_frame``: first frame of contact from the same lists; None if unknown.
    """

    source: Path
    paths: TrialPaths
    index: int
    dataset: str
    contact: bool | None = None
    first_frame: int | None = None


def imported_metadata(
    job: ImportJob,
    scene: Scene,
    trajectory: Trajectory,
    ids: NDArray[np.int16],
    *,
    look: str,
    movies: bool,
    rate: int,
    recorded: bool | None,
    free_movies: bool = False,
) -> Metadata:
    """Return the metadata of an imported trial.

    - ``job``, ``scene``, ``trajectory``: the import job, and the scene and motion that were read.
    - ``ids``: ids of the first frame (H, W); they give the stored picture size.
    - ``look``: ``redyellow`` or ``free``.
    - ``movies``, ``free_movies``: whether there are movies in the trial's own look, and further
      ones in free colours.
    - ``rate``: movie frames per second.
    - ``recorded``: outcome that the source recorded; None if it recorded none.
    """
    return Metadata(
        trial=job.paths.trial,
        dataset=job.dataset,
        scenario=job.paths.scenario,
        split=job.paths.split,
        index=job.index,
        preset=None,
        seed=None,
        look=look,
        width=ids.shape[1],
        height=ids.shape[0],
        frames=len(trajectory),
        observed_frames=OBSERVED_FRAMES,
        frame_time=FRAME_TIME,
        playback_rate=rate,
        completed=bool(trajectory.completed),
        engine=trajectory.engine,
        renderer="imported",
        package=f"physion {__version__}",
        digest=trajectory.digest(),
        scene_digest=scene.physics_digest(),
        movies=movies,
        free_movies=free_movies,
        recorded_contact=recorded,
    )


MAX_LIST_BYTES = 2**28
"""Largest metadata.json or labels.csv that is read, in bytes."""


def import_official(
    folder: Path,
    out: Path,
    *,
    name: str = IMPORTED,
    split: str | None = None,
    scenario: str | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> RunReport:
    """Import every official trial under ``folder`` into the dataset ``out``, and index it.

    Trials that exist are kept. A damaged file is reported and does not stop the others.

    Parameters
    ----------
    folder, out
        Folder to read, and folder of the dataset to write into.
    name, split
        Dataset and split of the trials; by default ``imported``, and the split in metadata.json
        next to the files, otherwise ``testing``.
    scenario
        Scenario of trials whose scenario cannot be found from their names.
    executor
        Where to run; by default one process per core.
    progress
        Shows the progress.

    Raises
    ------
    BadInputError
        If there are no official files, or ``out`` contains generated trials or cannot be written.
    UnknownNameError
        For an unknown split or scenario.
    """
    if split is not None and split not in SPLITS:
        raise UnknownNameError("split", split, SPLITS)
    if scenario is not None and scenario not in FOLDERS:
        raise UnknownNameError("scenario", scenario, FOLDERS)
    if not re.fullmatch(SAFE_NAME, name):
        raise BadInputError(f"dataset name {name!r} cannot be a file name")
    if not folder.is_dir():
        what = "is a file; give the folder that it is in" if folder.is_file() else "does not exist"
        raise BadInputError(f"{folder} {what}")
    if (folder / INDEX).exists():
        raise BadInputError(
            f"{folder} is a dataset of this package already: there is nothing to import"
        )
    if (out / SETTINGS).exists():
        raise BadInputError(f"{out} contains generated trials; import into another folder")
    jobs, failed = _plan(folder, out, name, split, scenario)
    with folder_for_writing(out):
        remove_leftovers(out)
        missing = {t: job for t, job in jobs.items() if not job.paths.trial_file.is_file()}
        made, broken = run_tasks(
            import_trial,
            missing,
            folder=out,
            what="importing",
            executor=executor,
            progress=progress,
        )
        table, problems = build_index(out)
        write_index(out, table)
    notes = {trial: notes for trial, notes in made.items() if notes}
    failed = {**failed, **broken, **problems}
    kept = tuple(trial for trial in jobs if trial not in missing)
    return RunReport(tuple(made), kept, failed, out / INDEX, notes)


def import_trial(job: ImportJob) -> tuple[str, ...]:
    """Write the files of one trial; return remarks about it."""
    if job.source.suffix == ".hdf5":
        return import_state(job)
    return import_movie(job)


def _plan(
    folder: Path, out: Path, dataset: str, split: str | None, scenario: str | None
) -> tuple[dict[str, ImportJob], dict[str, str]]:
    """Return the jobs by name of the trial, and why other files cannot be imported."""
    sources = list(_sources(folder))
    if not sources:
        raise BadInputError(
            f"{folder} has no official HDF5 file and no official movie, and is not a checkout "
            "of the original study (with human_accuracy-*.csv)"
        )
    lists = _FolderLists()
    jobs: dict[str, ImportJob] = {}
    failed: dict[str, str] = {}
    counts: Counter[tuple[str, str]] = Counter()
    seen: dict[str, Path] = {}
    for source in sources:
        trial = _trial_name(source)
        record = lists.record(source, trial)
        parents = [folder.name, *source.relative_to(folder).parts[:-1]]
        found = (
            scenario
            or guess_scenario(str(record.get("stimulus", "")), "", ())
            or guess_scenario(plain_name(trial), str(record.get("controller")), parents[::-1])
        )
        where = str(source.relative_to(folder))
        if found is None:
            failed[where] = "its scenario cannot be found from names; give it with --scenario"
        elif not re.fullmatch(SAFE_NAME, trial):
            failed[where] = f"{trial!r} cannot be the name of a trial"
        # Some file systems do not distinguish upper and lower case.
        elif (other := seen.setdefault(trial.lower(), source)) != source:
            failed[where] = f"there is a trial {trial!r} already: {other}"
        else:
            contact, first = record.get("contact"), record.get("first_frame")
            part = split or record.get("split", "testing")
            paths = TrialPaths(out, part, found, trial)
            index = counts[part, found]
            counts[part, found] += 1
            jobs[trial] = ImportJob(source, paths, index, dataset, contact, first)
    return jobs, failed


def _sources(folder: Path) -> Iterator[Path]:
    """Yield HDF5 files, then movies of trials without one; links are not followed."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    files = [path for path in files if not path.name.startswith(".")]
    states = [path for path in files if path.suffix == ".hdf5"]
    yield from states
    known = {plain_name(_trial_name(path)) for path in states}
    for path in files:
        trial = plain_name(_trial_name(path))
        # A stimulus in two looks is one trial, found by its movie in free colours.
        shown = path.name.endswith("_img.mp4") and "-redyellow" not in str(path)
        shown |= path.suffix == ".mp4" and (path.parent / EVALUATOR_LABELS).is_file()
        if shown and trial not in known:
            known.add(trial)
            yield path


def _trial_name(source: Path) -> str:
    """Return the name of the stimulus from its path: ``config/0007.hdf5`` is ``config_0007``."""
    stem = plain_name(source.name)
    if stem.isdecimal():
        return f"{source.parent.name}_{stem}"
    marked = "-redyellow" in source.name or source.parent.name.endswith("-redyellow")
    return redyellow_name(stem) if marked else stem


class _FolderLists:
    """Content of metadata.json and labels.csv of folders, each read once."""

    def __init__(self) -> None:
        self._metadata: dict[Path, dict[str, dict[str, Any]]] = {}
        self._labels: dict[Path, dict[str, bool]] = {}
        self._evaluated: dict[Path, dict[str, dict[str, Any]]] = {}

    def record(self, source: Path, trial: str) -> dict[str, Any]:
        """Return the record of a trial from the lists in the folder of ``source`` and above."""
        name = plain_name(trial)
        records = self._metadata_in(source.parent)
        numbered = [key for key in records if split_name(key)[1] == plain_name(source.name)]
        # A folder may have been renamed since its configuration was made.
        key = name if name in records or len(numbered) != 1 else numbered[0]
        found = dict(records.get(key, {}))
        found |= self._evaluated_in(source.parent).get(source.stem, {})
        for folder in source.parents[:3]:
            if "contact" not in found and name in (labels := self._labels_in(folder)):
                found["contact"] = labels[name]
        return found

    def _metadata_in(self, folder: Path) -> dict[str, dict[str, Any]]:
        if folder not in self._metadata:
            self._metadata[folder] = {}
            try:
                path = folder / "metadata.json"
                rows = parse_json(_read_list(path) or "[]", str(path))
            except BadInputError:
                rows = []
            for row in rows if isinstance(rows, list) else []:
                if isinstance(row, dict) and isinstance(row.get("stimulus_name"), str):
                    known = _read_record(row)
                    self._metadata[folder][plain_name(known["stimulus"])] = known
        return self._metadata[folder]

    def _evaluated_in(self, folder: Path) -> dict[str, dict[str, Any]]:
        """Return contact, its first frame, and split by name of a movie of version 1.5."""
        if folder not in self._evaluated:
            splits = {name: split for split, name in EVALUATOR_SPLITS.items()}
            about = {"split": splits[folder.name]} if folder.name in splits else {}
            path = folder / EVALUATOR_LABELS
            try:
                rows = parse_json(_read_list(path) or "{}", str(path))
            except BadInputError:
                rows = {}
            self._evaluated[folder] = {}
            for name, row in rows.items() if isinstance(rows, dict) else ():
                label = row.get("label") if isinstance(row, dict) else None
                if label in (0, 1):  # True is 1
                    first = row.get("contact_frame_label")
                    known = {"first_frame": first} if label and type(first) is int else {}
                    self._evaluated[folder][name] = about | {"contact": bool(label), **known}
        return self._evaluated[folder]

    def _labels_in(self, folder: Path) -> dict[str, bool]:
        if folder not in self._labels:
            rows = csv.reader((_read_list(folder / "labels.csv") or "").splitlines())
            self._labels[folder] = {
                plain_name(row[0]): row[1] == "True"
                for row in rows
                if len(row) == 2 and row[1] in ("True", "False")
            }
        return self._labels[folder]


def _read_record(row: dict[str, Any]) -> dict[str, Any]:
    """Return the needed values of a record of metadata.json, as far as their types are valid."""
    # Older files contain "b'config/0007'".
    stimulus = row["stimulus_name"].removeprefix("b'").removesuffix("'").replace("/", "_")
    found: dict[str, Any] = {
        "stimulus": stimulus,
        "controller": str(row.get("controller_name")),
    }
    if isinstance(row.get("does_target_contact_zone"), bool):
        found["contact"] = row["does_target_contact_zone"]
    if row.get("split") in SPLITS:
        found["split"] = row["split"]
    first = row.get("first_target_contact_zone_frame")
    if type(first) is int and first >= 0 and found.get("contact"):
        found["first_frame"] = first
    return found


def _read_list(path: Path) -> str | None:
    """Return the text of a file; None if it is absent or larger than `MAX_LIST_BYTES`."""
    if path.is_symlink() or not path.is_file() or path.stat().st_size > MAX_LIST_BYTES:
        return None
    return path.read_text(encoding="utf-8", errors="replace")


# Import of official movies without HDF5 files, which gives trials without motion.
#
# PhysionTest-Core, the most common download, has movies, maps and labels, but no motion. A trial
# imported from it can be used by models that see pictures. Its state is unknown: all poses are
# NaN, the two bodies are placeholders called ``agent`` and ``patient``, the engine is ``imported:
# movie alone``, and the frame of first contact is None unless the metadata.json next to the movie
# has it. The digests of motion and scene are of the movie, so that trials differ by them.

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
    labels = Labels(job.contact, first, _observed(job.contact, first))
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
    shown = digest_of(own.full)
    metadata = replace(metadata, digest=shown, scene_digest=shown)
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
        engine=MOVIE_ALONE,
    )


# Import of one official HDF5 file: scene, motion, contacts, labels and movies.

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
        movies = _import_hdf5_movies(job, file, reader, frames)
        ids = _import_hdf5_ids(
            file, reader, scene, trajectory, movies.size if movies else UNSEEN_SIZE
        )
        if file.has(f"{reader.frames[0]}/images/_depth"):
            motion.depth(trajectory, 0)  # notes how depth is stored
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
    """Return the labels stored in the file, else as in metadata.json, else from its contacts."""
    labels = label_contact(scene, trajectory)
    if labelled is None and job.contact is None:
        return labels
    touches = np.flatnonzero(labelled) if labelled is not None else np.zeros(0)
    first = int(touches[0]) if len(touches) else None
    contact = first is not None
    if labelled is None:
        contact, first = bool(job.contact), job.first_frame
    return replace(labels, contact=contact, first_frame=first, observed=_observed(contact, first))


def _observed(contact: bool, first: int | None) -> bool | None:
    """Return whether a contact is observed, by its first frame; None if that is not known."""
    if first is None:
        return None if contact else False
    return first < OBSERVED_FRAMES


def _import_hdf5_movies(
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


def _import_hdf5_ids(
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
