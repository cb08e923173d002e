"""Official files become a dataset of ours.

Two kinds of folders are read, at any depth and mixed:

- HDF5 files, as the generator leaves them (``<config>/0007.hdf5`` with ``0007_img.mp4`` and
  ``metadata.json`` beside) or as they were published (``hdf5s/<stimulus>.hdf5``): scene, motion,
  contacts, labels, camera; movies are those beside the file, or made of the pictures in it.
- Movies without HDF5 files, as in PhysionTest-Core (``mp4s/<stimulus>_img.mp4`` with ``maps``,
  ``mp4s-redyellow`` and ``labels.csv``) or in a configuration's folder: movies, map and label.
  How things moved is not in them: see `physion.trials.official.import_movie`.

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

from physion.atomic import folder_lock, remove_leftovers
from physion.compute.executor import Executor
from physion.compute.progress import Track
from physion.compute.run_tasks import RunReport, run_tasks
from physion.errors import BadInputError, UnknownNameError
from physion.stimulus_names import FOLDERS, guess_scenario, plain_name
from physion.trials.index import build_index, write_index
from physion.trials.layout import INDEX, SAFE_NAME, SETTINGS, TrialPaths
from physion.trials.making.plan import SPLITS
from physion.trials.official.job import ImportJob
from physion.trials.official.names import redyellow_name, split_name

MAX_LIST_BYTES = 2**28
"""Largest metadata.json or labels.csv that is read."""


def import_official(
    folder: Path,
    out: Path,
    *,
    name: str | None = None,
    split: str | None = None,
    scenario: str | None = None,
    executor: Executor | None = None,
    track: Track | None = None,
) -> RunReport:
    """Bring every official trial under ``folder`` into the dataset ``out``, then index it.

    ``name`` is the dataset's; ``split`` is where the trials go; by default both are those that
    files of our own come from, else `IMPORTED` and ``testing``. ``scenario`` is that of trials
    whose names do not say it. Files of our own become the trials that they were made of (see
    `physion.trials.official.round_trip`). Trials that are there already are kept, and a bad
    file fails alone. Raises `BadInputError` where there is no official file at all, or ``out``
    holds something else or cannot be written.
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
        raise BadInputError(f"{folder} is a dataset of ours already: nothing is to be imported")
    if (out / SETTINGS).exists():
        raise BadInputError(f"{out} holds generated trials; import into another folder")
    jobs, failed = _plan(folder, out, name, split, scenario)
    try:
        out.mkdir(parents=True, exist_ok=True)
        with folder_lock(out):
            remove_leftovers(out)
            missing = {t: job for t, job in jobs.items() if not job.paths.trial_file.is_file()}
            made, broken = run_tasks(
                import_trial,
                missing,
                folder=out,
                what="importing",
                executor=executor,
                track=track,
            )
            table, problems = build_index(out)
            write_index(out, table)
    except OSError as error:
        raise BadInputError(f"cannot write into {out}: {error.strerror or error}") from error
    notes = {trial: notes for trial, notes in made.items() if notes}
    failed = {**failed, **broken, **problems}
    kept = tuple(trial for trial in jobs if trial not in missing)
    return RunReport(tuple(made), kept, failed, out / INDEX, notes)


def import_trial(job: ImportJob) -> tuple[str, ...]:
    """Write the files of one trial; what one should know of it."""
    # Engine and renderer are loaded by whoever imports, not by whoever lists.
    if job.source.suffix == ".hdf5":
        from physion.trials.official.import_hdf5 import import_state

        return import_state(job)
    from physion.trials.official.import_movie import import_movie

    return import_movie(job)


def _plan(
    folder: Path, out: Path, dataset: str | None, split: str | None, scenario: str | None
) -> tuple[dict[str, ImportJob], dict[str, str]]:
    """Jobs by trial name, and why other files cannot be one."""
    sources = list(_sources(folder))
    if not sources:
        raise BadInputError(f"{folder} holds no official HDF5 file and no official movie")
    lists = _Lists()
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
            failed[where] = "no name says which scenario it is; say it with --scenario"
        elif not re.fullmatch(SAFE_NAME, trial):
            failed[where] = f"{trial!r} cannot be the name of a trial"
        # Some file systems take names that differ only in case for one.
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
    """HDF5 files first, then movies of trials that have none; links are not followed."""
    files = sorted(path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    files = [path for path in files if not path.name.startswith(".")]
    states = [path for path in files if path.suffix == ".hdf5"]
    yield from states
    known = {plain_name(_trial_name(path)) for path in states}
    for path in files:
        trial = plain_name(_trial_name(path))
        # The same stimulus in two looks is one trial: free colours are its own look.
        shown = path.name.endswith("_img.mp4") and "-redyellow" not in str(path)
        if shown and trial not in known:
            known.add(trial)
            yield path


def _trial_name(source: Path) -> str:
    """Stimulus name by place: ``config/0007.hdf5`` is ``config_0007``."""
    stem = plain_name(source.name)
    if stem.isdecimal():
        return f"{source.parent.name}_{stem}"
    marked = "-redyellow" in source.name or source.parent.name.endswith("-redyellow")
    return redyellow_name(stem) if marked else stem


class _Lists:
    """metadata.json and labels.csv of the folders, each read once."""

    def __init__(self) -> None:
        self._metadata: dict[Path, dict[str, dict[str, Any]]] = {}
        self._labels: dict[Path, dict[str, bool]] = {}

    def record(self, source: Path, trial: str) -> dict[str, Any]:
        """What the lists beside ``source`` and above it say of a trial."""
        name = plain_name(trial)
        records = self._of_folder(source.parent)
        numbered = [key for key in records if split_name(key)[1] == plain_name(source.name)]
        # A folder may be called otherwise than the configuration was when it was made.
        key = name if name in records or len(numbered) != 1 else numbered[0]
        found = dict(records.get(key, {}))
        for folder in source.parents[:3]:
            if "contact" not in found and name in (labels := self._labels_in(folder)):
                found["contact"] = labels[name]
        return found

    def _of_folder(self, folder: Path) -> dict[str, dict[str, Any]]:
        if folder not in self._metadata:
            self._metadata[folder] = {}
            try:
                rows = json.loads(_small(folder / "metadata.json") or "[]")
            except ValueError:
                rows = []
            for row in rows if isinstance(rows, list) else []:
                if isinstance(row, dict) and isinstance(row.get("stimulus_name"), str):
                    known = _known(row)
                    self._metadata[folder][plain_name(known["stimulus"])] = known
        return self._metadata[folder]

    def _labels_in(self, folder: Path) -> dict[str, bool]:
        if folder not in self._labels:
            rows = csv.reader((_small(folder / "labels.csv") or "").splitlines())
            self._labels[folder] = {
                plain_name(row[0]): row[1] == "True"
                for row in rows
                if len(row) == 2 and row[1] in ("True", "False")
            }
        return self._labels[folder]


def _known(row: dict[str, Any]) -> dict[str, Any]:
    """What we use of a record of metadata.json, as far as it has the right types."""
    # Older files have it as "b'config/0007'".
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


def _small(path: Path) -> str | None:
    """The text of a file of a reasonable size, None where there is none."""
    if path.is_symlink() or not path.is_file() or path.stat().st_size > MAX_LIST_BYTES:
        return None
    return path.read_text(encoding="utf-8", errors="replace")
