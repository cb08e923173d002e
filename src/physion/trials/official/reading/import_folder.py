"""Import of folders of official files into a dataset.

Two kinds of folders are read, at any depth and mixed:

- HDF5 files, as written by the generator (``<config>/0007.hdf5`` next to ``0007_img.mp4`` and
  ``metadata.json``) or as published (``hdf5s/<stimulus>.hdf5``): scene, motion, contacts, labels
  and camera. Movies are those next to the file, or are made from the pictures in it.
- Movies without HDF5 files, as in PhysionTest-Core (``mp4s/<stimulus>_img.mp4`` with ``maps``,
  ``mp4s-redyellow`` and ``labels.csv``) or in the folder of a configuration: movies, map and label.
  They have no motion; see `physion.trials.official.reading.import_movie`.

Versions with red agent and yellow patient keep ``-redyellow`` in their names.
"""

from __future__ import annotations

import csv
import json
import re
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from physion.atomic import folder_for_writing, remove_leftovers
from physion.compute.executor import Executor
from physion.compute.progress import Progress
from physion.compute.run_tasks import RunReport, run_tasks
from physion.errors import BadInputError, UnknownNameError
from physion.stimulus_names import FOLDERS, guess_scenario, plain_name
from physion.trials.index import build_index, write_index
from physion.trials.layout import INDEX, SAFE_NAME, SETTINGS, TrialPaths
from physion.trials.making.plan import SPLITS
from physion.trials.official.names import redyellow_name, split_name
from physion.trials.official.reading.job import ImportJob

MAX_LIST_BYTES = 2**28
"""Largest metadata.json or labels.csv that is read, in bytes."""


def import_official(
    folder: Path,
    out: Path,
    *,
    name: str | None = None,
    split: str | None = None,
    scenario: str | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> RunReport:
    """Import every official trial under ``folder`` into the dataset ``out``, and index it.

    Files that this package exported become the trials that they were made from (see
    `physion.trials.official.reading.round_trip`). Trials that exist are kept. A damaged file is
    reported and does not stop the others.

    Parameters
    ----------
    folder, out
        Folder to read, and folder of the dataset to write into.
    name, split
        Dataset and split of the trials; by default those stored in files that this package
        exported, and otherwise ``imported`` and ``testing``.
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
    if name is not None and not re.fullmatch(SAFE_NAME, name):
        raise BadInputError(f"dataset name {name!r} cannot be a file name")
    if not folder.is_dir():
        raise BadInputError(f"folder {folder} does not exist")
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
    # Imported late: loading engine and renderer takes time.
    if job.source.suffix == ".hdf5":
        from physion.trials.official.reading.import_hdf5 import import_state

        return import_state(job)
    from physion.trials.official.reading.import_movie import import_movie

    return import_movie(job)


def _plan(
    folder: Path, out: Path, dataset: str | None, split: str | None, scenario: str | None
) -> tuple[dict[str, ImportJob], dict[str, str]]:
    """Return the jobs by name of the trial, and why other files cannot be imported."""
    sources = list(_sources(folder))
    if not sources:
        raise BadInputError(f"{folder} has no official HDF5 file and no official movie")
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

    def record(self, source: Path, trial: str) -> dict[str, Any]:
        """Return the record of a trial from the lists in the folder of ``source`` and above."""
        name = plain_name(trial)
        records = self._metadata_in(source.parent)
        numbered = [key for key in records if split_name(key)[1] == plain_name(source.name)]
        # A folder may have been renamed since its configuration was made.
        key = name if name in records or len(numbered) != 1 else numbered[0]
        found = dict(records.get(key, {}))
        for folder in source.parents[:3]:
            if "contact" not in found and name in (labels := self._labels_in(folder)):
                found["contact"] = labels[name]
        return found

    def _metadata_in(self, folder: Path) -> dict[str, dict[str, Any]]:
        if folder not in self._metadata:
            self._metadata[folder] = {}
            try:
                rows = json.loads(_read_list(folder / "metadata.json") or "[]")
            except ValueError:
                rows = []
            for row in rows if isinstance(rows, list) else []:
                if isinstance(row, dict) and isinstance(row.get("stimulus_name"), str):
                    known = _read_record(row)
                    self._metadata[folder][plain_name(known["stimulus"])] = known
        return self._metadata[folder]

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
