"""Export of a dataset in the folder layouts that published code reads (see `layouts`)."""

from __future__ import annotations

import dataclasses
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physion.atomic import folder_for_writing, remove_leftovers, write_atomic
from physion.compute.executor import Executor
from physion.compute.progress import Progress
from physion.compute.run_tasks import RunReport, run_tasks
from physion.errors import BadInputError, UnknownNameError
from physion.trials.dataset import Dataset
from physion.trials.files import encode_png
from physion.trials.indexed_file import IndexedFile
from physion.trials.layout import TrialPaths
from physion.trials.metadata import Metadata
from physion.trials.official.names import TRIAL_FILE
from physion.trials.official.read_hdf5 import OfficialFile
from physion.trials.official.writing.layouts import LAYOUTS, Content, Files
from physion.trials.trial_file import Trial
from physion.trials.video import MovieEncoder

_SAME = ("digest", "look", "width", "height", "playback_rate", "package")
"""Metadata that an exported file must share with its trial to be kept."""
_IMAGE = "frames/0000/images/_img"


@dataclass(frozen=True)
class ExportJob:
    """One trial to export.

    Parameters
    ----------
    paths
        Files of the trial.
    out, files
        Folder to write into, and contents by path below it; the last is written last.
    stored
        Files of the index by column: trial file, own movie, and that in free colours.
    images
        Whether HDF5 files get pictures.
    """

    paths: TrialPaths
    out: Path
    files: Files
    stored: Mapping[str, IndexedFile]
    images: bool = True

    @property
    def last(self) -> tuple[Path, Content]:
        """Path and content of the file that is written last."""
        name, content = list(self.files.items())[-1]
        return self.out / name, content


def export_official(
    dataset: Path,
    out: Path,
    *,
    layout: str = "official",
    verify: bool = True,
    split: str | None = None,
    scenario: str | None = None,
    images: bool = True,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> RunReport:
    """Export trials of a dataset in a layout of published code.

    Exported trials with the same motion and look are kept. Lists are then written for everything
    in ``out``. An error in one trial is reported and does not stop the others.

    Parameters
    ----------
    dataset, out
        Folder of the dataset, and folder to write into, outside the dataset.
    layout
        One of `LAYOUTS`. Trials that have no place in it are named in the notes.
    verify
        Compare trial files and movies with their SHA-256 in the index.
    split, scenario
        Trials to export; by default all.
    images
        Whether HDF5 files get pictures; without, they are made 20 times as fast.
    executor
        Where to run; by default one process per core.
    progress
        Shows the progress.

    Raises
    ------
    BadInputError
        If ``dataset`` is not a dataset, it has no such trials, two trials would have the same
        name, or ``out`` cannot be written.
    UnknownNameError
        For an unknown layout.
    """
    if layout not in LAYOUTS:
        raise UnknownNameError("layout", layout, LAYOUTS)
    source = Dataset(dataset, verify=verify)
    names = source.trials(split, scenario)
    if not names:
        raise BadInputError(
            f"{dataset} has no trial of split {split or 'any'!r} and scenario {scenario or 'any'!r}"
        )
    files = {column: source.files(column) for column in ("trial_file", "movie", "free_movie")}
    planned = {}
    for name in names:
        stored = {column: found[name] for column, found in files.items() if name in found}
        paths = source.paths(name)
        planned[name] = ExportJob(paths, out, LAYOUTS[layout].files(paths), stored, images)
    jobs = {name: job for name, job in planned.items() if job.files}
    notes = _without_place(planned, layout)
    if not jobs:
        raise BadInputError(f"{dataset}: {notes[layout][0]}")
    _check(jobs, dataset, out)
    with folder_for_writing(out):
        remove_leftovers(out)
        kept = {name for name, job in jobs.items() if _is_done(job)}
        missing = {name: job for name, job in jobs.items() if name not in kept}
        made, failed = run_tasks(
            export_trial,
            missing,
            folder=out,
            what="exporting",
            executor=executor,
            progress=progress,
        )
        index, broken = LAYOUTS[layout].write_lists(out)
    in_order = tuple(name for name in jobs if name in kept)
    return RunReport(tuple(made), in_order, {**failed, **broken}, index, notes)


def _without_place(planned: Mapping[str, ExportJob], layout: str) -> dict[str, tuple[str, ...]]:
    """Return a note on the trials that the layout has no files for, by name of the layout."""
    left = Counter(
        f"{job.paths.split} {job.paths.scenario}" for job in planned.values() if not job.files
    )
    if not left:
        return {}
    kinds = ", ".join(f"{count} {kind}" for kind, count in left.items())
    return {layout: (f"{left.total()} trials have no place in this layout ({kinds})",)}


def export_trial(job: ExportJob) -> str:
    """Write all files of one trial; return its name."""
    file = job.stored["trial_file"]
    trial = Trial(file.read(), f"trial file {file.path}")
    if not np.isfinite(trial.trajectory.positions).all() and "state" in _kinds(job):
        raise BadInputError(
            f"the motion of trial {job.paths.trial!r} is unknown (it was imported from a movie "
            "alone), and official files require it"
        )
    made = {name: _content(job, trial, content) for name, content in job.files.items()}
    for name, data in made.items():
        path = job.out / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, data)
    return job.paths.trial


def _kinds(job: ExportJob) -> set[str]:
    return {content.kind for content in job.files.values()}


def _content(job: ExportJob, trial: Trial, content: Content) -> bytes:
    """Return the bytes of one file."""
    # Imported late: loading engine and renderer takes time.
    from physion.rendering.renderer import role_map
    from physion.trials.official.writing.hdf5 import official_file

    if content.kind == "state":
        return official_file(trial, look=content.look, images=job.images)[0]
    if content.kind == "map":
        return encode_png(role_map(trial.ids, trial.scene))
    if content.kind == "record":
        return json.dumps(_record(trial.metadata, content) | _label(trial)).encode()
    return _movie(job, trial, content.look or trial.metadata.look)


def _record(meta: Metadata, content: Content) -> dict[str, Any]:
    values = dataclasses.asdict(meta) | {"look": content.look or meta.look}
    return {name: values[name] for name in _SAME}


def _label(trial: Trial) -> dict[str, Any]:
    labels = trial.labels
    first = labels.first_frame if labels.contact else None
    frame = trial.metadata.frames // 2 if first is None else first
    return {"label": labels.contact, "contact_frame_label": frame}


def _movie(job: ExportJob, trial: Trial, look: str) -> bytes:
    """Return the movie of the trial in a look: that of the index if there is one, else rendered."""
    meta = trial.metadata
    column = "movie" if look == meta.look else "free_movie" if look == "free" else None
    if column is not None and column in job.stored:
        return job.stored[column].read()
    if not np.isfinite(trial.trajectory.positions).all():
        raise BadInputError(
            f"trial {job.paths.trial!r} has no movie in the look {look!r}, and its motion is "
            "unknown, so none can be rendered"
        )
    encoder = MovieEncoder(meta.width, meta.height, meta.frames, rate=meta.playback_rate)
    renderer = trial.renderer(look=look)
    for frame in range(meta.frames):
        color = renderer.render(frame).color
        assert color is not None
        encoder.add(color)
    return encoder.finish()


def _check(jobs: Mapping[str, ExportJob], dataset: Path, out: Path) -> None:
    """Raise `BadInputError` if ``out`` is in the dataset or two trials would share a file."""
    if out.resolve().is_relative_to(dataset.resolve()):
        raise BadInputError(f"{out} lies in the dataset {dataset}; choose a folder outside it")
    seen: dict[str, str] = {}
    for name, job in jobs.items():
        # Some file systems do not distinguish upper and lower case.
        other = seen.setdefault(str(job.last[0]).lower(), name)
        if other != name:
            raise BadInputError(
                f"trials {other!r} and {name!r} would both be {job.last[0]}; export them by "
                "--split or --scenario into different folders"
            )


def _is_done(job: ExportJob) -> bool:
    """Return whether all files of the trial exist and the last one has its motion and look."""
    if not all((job.out / name).is_file() for name in job.files):
        return False
    path, content = job.last
    try:
        wanted = _record(Trial.open(job.paths.trial_file).metadata, content)
        found = json.loads(path.read_bytes()) if content.kind == "record" else _stored(path, job)
    except (BadInputError, OSError, ValueError):
        return False
    return isinstance(found, dict) and all(found.get(name) == wanted[name] for name in _SAME)


def _stored(path: Path, job: ExportJob) -> Any:
    """Return the metadata in an exported HDF5 file; None if it lacks wanted pictures."""
    with OfficialFile.open(path) as file:
        if not file.has(TRIAL_FILE) or (job.images and not file.has(_IMAGE)):
            return None
        return json.loads(file.text("physion/metadata"))
