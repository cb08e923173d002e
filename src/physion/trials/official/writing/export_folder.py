"""Export of a dataset in the folder layouts of the original study, for code written for those.

::

    OUT/labels.csv                          as in PhysionTest-Core: <stimulus>_img, True or False
    OUT/stimulus_names_and_labels.csv       as published; URLs are paths below OUT, and the
                                            responses of people ("correct") are empty
    OUT/Dominoes/maps/<stimulus>_map.png            PhysionTest-Core: the testing split
    OUT/Dominoes/mp4s/<stimulus>_img.mp4            free colours
    OUT/Dominoes/mp4s-redyellow/<config>-redyellow_0000_img.mp4
    OUT/Dominoes/<config>/0000.hdf5         as the generator writes a configuration, every split;
                         /0000_img.mp4      in the trial's own look
                         /metadata.json
                         /trial_stats.json

A trial called ``dominoes_testing_0007`` is number 0007 of the configuration ``dominoes_testing``.
Scenario folders are capitalised, as in the published archives.
"""

from __future__ import annotations

import csv
import io
import json
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from physion.atomic import folder_for_writing, remove_leftovers, write_atomic
from physion.compute.executor import Executor
from physion.compute.progress import Progress
from physion.compute.run_tasks import RunReport, run_tasks
from physion.errors import BadInputError
from physion.stimulus_names import FOLDERS
from physion.trials.dataset import Dataset
from physion.trials.files import encode_png
from physion.trials.layout import TrialPaths
from physion.trials.official.names import TRIAL_FILE, redyellow_name, split_name
from physion.trials.official.read_hdf5 import OfficialFile
from physion.trials.official.writing.metadata import trial_stats
from physion.trials.trial_file import Metadata, Trial
from physion.trials.video import MovieEncoder, count_frames

CORE_SPLIT = "testing"
"""Split that PhysionTest-Core consists of."""
_SAME = ("digest", "look", "width", "height", "playback_rate", "package")
"""Metadata that an exported file must share with its trial to be kept."""


@dataclass(frozen=True)
class ExportJob:
    """One trial to export: paths of its files, and the folder to write into."""

    paths: TrialPaths
    out: Path

    @property
    def stimulus(self) -> str:
        """Official name of the trial: configuration and number."""
        return "_".join(split_name(self.paths.trial))

    @property
    def folder(self) -> Path:
        """Folder of the scenario."""
        return self.out / FOLDERS.get(self.paths.scenario, self.paths.scenario)

    @property
    def hdf5(self) -> Path:
        """Path of the HDF5 file, in the folder of the configuration."""
        config, number = split_name(self.paths.trial)
        return self.folder / config / f"{number}.hdf5"

    def movies(self) -> dict[Path, str | None]:
        """Return the looks of the movies to write by path; None is the trial's own look."""
        found: dict[Path, str | None] = {self.hdf5.with_name(f"{self.hdf5.stem}_img.mp4"): None}
        if self.paths.split == CORE_SPLIT:
            found[self.folder / "mp4s" / f"{self.stimulus}_img.mp4"] = "free"
            redyellow = f"{redyellow_name(self.stimulus)}_img.mp4"
            found[self.folder / "mp4s-redyellow" / redyellow] = "redyellow"
        return found

    def map(self) -> Path | None:
        """Return the path of the map; None if the trial is not in `CORE_SPLIT`."""
        if self.paths.split != CORE_SPLIT:
            return None
        return self.folder / "maps" / f"{self.stimulus}_map.png"


def export_official(
    dataset: Path,
    out: Path,
    *,
    split: str | None = None,
    scenario: str | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> RunReport:
    """Export trials of a dataset in the official layouts, as shown at the top of the module.

    Exported trials with the same motion and look are kept. Lists and statistics are then written
    for everything in ``out``. An error in one trial is reported and does not stop the others.

    Parameters
    ----------
    dataset, out
        Folder of the dataset, and folder to write into, outside the dataset.
    split, scenario
        Trials to export; by default all.
    executor
        Where to run; by default one process per core.
    progress
        Shows the progress.

    Raises
    ------
    BadInputError
        If ``dataset`` is not a dataset, it has no such trials, two trials would have the same
        name, or ``out`` cannot be written.
    """
    source = Dataset(dataset)
    names = source.trials(split, scenario)
    if not names:
        raise BadInputError(
            f"{dataset} has no trial of split {split or 'any'!r} and scenario {scenario or 'any'!r}"
        )
    jobs = {name: ExportJob(source.paths(name), out) for name in names}
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
        index, broken = _write_lists(out)
    in_order = tuple(name for name in jobs if name in kept)
    return RunReport(tuple(made), in_order, {**failed, **broken}, index)


def export_trial(job: ExportJob) -> str:
    """Write all files of one trial, the HDF5 file last; return the name of its stimulus."""
    # Imported late: loading engine and renderer takes time.
    from physion.rendering.renderer import role_map
    from physion.trials.official.writing.hdf5 import official_file

    trial = Trial.open(job.paths.trial_file)
    if not np.isfinite(trial.trajectory.positions).all():
        raise BadInputError(
            f"the motion of trial {job.paths.trial!r} is unknown (it was imported from a movie "
            "alone), and official files require it"
        )
    data, _ = official_file(trial)
    map_path = job.map()
    for path in (*job.movies(), job.hdf5, *([map_path] if map_path else [])):
        path.parent.mkdir(parents=True, exist_ok=True)
    for path, look in job.movies().items():
        write_atomic(path, _movie(job.paths, trial, look or trial.metadata.look))
    if map_path is not None:
        write_atomic(map_path, encode_png(role_map(trial.ids, trial.scene)))
    write_atomic(job.hdf5, data)
    return job.stimulus


def _movie(paths: TrialPaths, trial: Trial, look: str) -> bytes:
    """Return the movie of the trial in a look: a copy if there is one, else rendered."""
    meta = trial.metadata
    own = paths.movie if look == meta.look else paths.free_movie
    if (meta.movies if look == meta.look else look == "free" and meta.free_movies) and (
        count_frames(own) == meta.frames
    ):
        return own.read_bytes()
    encoder = MovieEncoder(meta.width, meta.height, meta.frames, rate=meta.playback_rate)
    for frame in range(meta.frames):
        color = trial.render(frame, look=look).color
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
        other = seen.setdefault(str(job.hdf5).lower(), name)
        if other != name:
            raise BadInputError(
                f"trials {other!r} and {name!r} would both be {job.hdf5}; export them by --split "
                "or --scenario into different folders"
            )


def _is_done(job: ExportJob) -> bool:
    """Return whether all files of the trial exist and its HDF5 file has its motion and look."""
    map_path = job.map()
    files = [job.hdf5, *job.movies(), *([map_path] if map_path else [])]
    if not all(path.is_file() for path in files):
        return False
    try:
        wanted: Metadata = Trial.open(job.paths.trial_file).metadata
        with OfficialFile.open(job.hdf5) as file:
            found = json.loads(file.text("physion/metadata")) if file.has(TRIAL_FILE) else None
    except (BadInputError, ValueError):
        return False
    return isinstance(found, dict) and all(
        found.get(name) == getattr(wanted, name) for name in _SAME
    )


def _write_lists(out: Path) -> tuple[Path, dict[str, str]]:
    """Write metadata.json, trial_stats.json and the lists of all trials in ``out``.

    Returns the path of ``labels.csv``, and errors by path of unreadable files.
    """
    by_folder: dict[Path, list[dict[str, Any]]] = defaultdict(list)
    failed = {}
    for path in _files(out):
        try:
            with OfficialFile.open(path) as file:
                by_folder[path.parent].append(json.loads(file.text("physion/record")))
        except (BadInputError, ValueError) as error:
            failed[str(path.relative_to(out))] = f"{error}; delete it to make it again"
    rows = []
    for folder, records in by_folder.items():
        write_atomic(folder / "metadata.json", _json(records))
        write_atomic(folder / "trial_stats.json", _json(trial_stats(records)))
        rows += [row for record in records if (row := _list_row(out, folder, record))]
    labels = [("", "ground truth outcome")]
    labels += [(f"{row['stim_ID']}_img", row["label"]) for row in rows]
    write_atomic(out / "labels.csv", _csv(labels))
    columns = ("stim_ID", "scenario", "stim_url", "map_url", "hdf5_url", "correct", "label")
    table = [columns, *(tuple(row[column] for column in columns) for row in rows)]
    write_atomic(out / "stimulus_names_and_labels.csv", _csv(table))
    return out / "labels.csv", failed


def _files(out: Path) -> list[Path]:
    return sorted(out.glob("*/*/[0-9][0-9][0-9][0-9].hdf5"))


def _list_row(out: Path, folder: Path, record: Mapping[str, Any]) -> dict[str, str] | None:
    """Return the row of a trial in the lists of PhysionTest-Core; None for other trials."""
    stimulus = str(record["stimulus_name"])
    movie = folder.parent / "mp4s" / f"{stimulus}_img.mp4"
    if not movie.is_file():
        return None
    files = {
        "stim_url": movie,
        "map_url": folder.parent / "maps" / f"{stimulus}_map.png",
        "hdf5_url": folder / f"{split_name(stimulus)[1]}.hdf5",
    }
    titles = {title: name for name, title in FOLDERS.items()}
    return {
        "stim_ID": stimulus,
        "scenario": titles.get(folder.parent.name, folder.parent.name),
        **{column: path.relative_to(out).as_posix() for column, path in files.items()},
        "correct": "",
        "label": str(bool(record["does_target_contact_zone"])),
    }


def _json(value: Any) -> bytes:
    return (json.dumps(value, indent=4) + "\n").encode()


def _csv(rows: list[Any]) -> bytes:
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows(rows)
    return buffer.getvalue().encode()
