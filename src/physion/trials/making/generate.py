"""Generation of a dataset: choose the scene of every trial, simulate, label, render and write it.

A trial is a pure function of its task and of the settings, and its files are written atomically.
Therefore no state is kept between runs: a run makes whatever is missing, in any order and with any
number of processes, and an interrupted run is continued by the same call.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from physion.compute.run_tasks import RunReport, run_tasks
from physion.compute.tasks import Executor, Progress, TaskOutcome, workers_kept
from physion.core.errors import BadInputError, PhysionError, UnknownNameError
from physion.core.files import (
    folder_for_writing,
    has_digest,
    remove_leftovers,
    write_atomic,
)
from physion.core.seeds import stable_hash
from physion.core.settings import as_json, read_json
from physion.physics.engine import make_engine
from physion.scenes.sampling.build import as_record, scenarios
from physion.scenes.sampling.sample import get_preset
from physion.trials.dataset import Dataset
from physion.trials.files import FAILURES, INDEX, SETTINGS, find_trials
from physion.trials.index import (
    as_table,
    build_index,
    has_sizes,
    index_row,
    read_index,
    write_index,
)
from physion.trials.making.choose import short
from physion.trials.making.cues import cue_tasks
from physion.trials.making.pairs import check_kinds, pair_tasks
from physion.trials.making.plan import (
    PAIR,
    GenerateJob,
    GenerateSettings,
    TrialTask,
    check_names,
    plan_dataset,
)
from physion.trials.making.whatif import CUES, KINDS, whatif_tasks
from physion.trials.trial_file import Trial

INDEX_EVERY = 500
"""Trials after which a run writes the index."""


def make_trials(
    folder: Path,
    tasks: Sequence[TrialTask],
    settings: GenerateSettings | None = None,
    *,
    executor: Executor | None = None,
    progress: Progress | None = None,
    make: Callable[[GenerateJob], str] | None = None,
) -> RunReport:
    """Make all trials of ``tasks`` that are missing in ``folder``, then the index.

    If a trial fails, its traceback is written to ``failures/`` and the others continue. Trials of
    other tasks in the folder are not changed and stay in the index.

    Parameters
    ----------
    folder
        Folder of the dataset; made if it does not exist.
    tasks
        Trials to make, all of one dataset.
    settings
        How to choose, render and store trials; must equal the settings of earlier runs in the
        folder.
    executor
        Where to run; by default one process per core.
    progress
        Shows the progress.
    make
        Function that makes one trial; by default `make_trial`.

    Raises
    ------
    BadInputError
        If the folder cannot be written, is not a dataset, or was made with other settings.
    PhysionError
        If the disk is full or another process writes into the folder. Finished trials stay, and
        the same call continues.
    """
    if executor is None:
        from physion.compute.local import LocalExecutor

        executor = LocalExecutor()
    if make is None:
        # Imported late: loading engine and renderer takes time.
        from physion.trials.making.make import make_trial

        make = make_trial
    settings = settings or GenerateSettings()
    check_names(tasks)
    datasets = {task.dataset for task in tasks}
    if len(datasets) != 1:
        raise BadInputError(f"one folder takes one dataset, not {sorted(datasets) or 'none'}")
    jobs = {task.trial: GenerateJob(task, folder, settings) for task in tasks}
    with folder_for_writing(folder), workers_kept(executor):
        _fix_settings(folder, datasets.pop(), settings, tasks)
        remove_leftovers(folder)
        index = _known_index(folder)
        listed = {str(row["trial"]): row for row in index.to_dict("records")}
        missing = [n for n, job in jobs.items() if not _is_made(job, listed.get(n))]
        todo, made, failed = missing, dict[str, dict[str, Any] | None](), dict[str, str]()
        note = _Notes(folder, jobs, dict(listed))
        while True:
            new, refused = run_tasks(
                _MakeAndRead(make),
                _without_taken([jobs[name] for name in todo], index),
                folder=folder,
                what="generating",
                executor=executor,
                progress=progress,
                on_outcome=note,
            )
            made, failed = {**made, **new}, {**failed, **refused}
            index, problems = _update_index(folder, made)
            todo = _repeated(index, jobs)
            if not todo:
                break
            for name in todo:
                jobs[name].paths.trial_file.unlink()
                made.pop(name, None)
    kept = [name for name in jobs if name not in missing and name not in problems]
    return RunReport(list(made), kept, {**failed, **problems}, folder / INDEX)


def _known_index(folder: Path) -> pd.DataFrame:
    """Return the index of the folder, or one without trials if it has none."""
    try:
        return read_index(folder)
    except BadInputError:
        return as_table([])


@dataclass(frozen=True)
class _MakeAndRead:
    """Function that makes a trial and returns its row of the index, where the trial is made.

    Returns None for a trial that cannot be read: the index says why.
    """

    make: Callable[[GenerateJob], str]

    def __call__(self, job: GenerateJob) -> dict[str, Any] | None:
        self.make(job)
        try:
            return index_row(job.paths)
        except BadInputError:
            return None


def _without_taken(jobs: Sequence[GenerateJob], index: pd.DataFrame) -> dict[str, GenerateJob]:
    """Return jobs by trial, with the physics that other trials have; see `GenerateJob`."""
    taken: dict[tuple[str, str], dict[int, int]] = {}
    columns = (index[name] for name in ("split", "scenario", "index", "scene_digest"))
    for split, scenario, number, digest in zip(*columns, strict=True):
        others = taken.setdefault((split, scenario), {})
        others[short(digest)] = min(number, others.get(short(digest), number))
    found = {}
    for job in jobs:
        task = job.task
        others = taken.get((task.split, task.scenario), {})
        found[task.trial] = dataclasses.replace(job, taken=others) if task.presets else job
    return found


def _repeated(index: pd.DataFrame, jobs: Mapping[str, GenerateJob]) -> list[str]:
    """Return the chosen trials that have the physics of one with a lower number.

    Scenes are chosen at the same time, so that two trials may find the same one. The result does
    not depend on the order of the work, since it is always the higher number that searches again.
    """
    ordered = index.sort_values("index", kind="stable")
    again = ordered[ordered.duplicated(["split", "scenario", "scene_digest"])]["trial"]
    return [str(name) for name in again if name in jobs and jobs[str(name)].task.presets]


def _is_made(job: GenerateJob, row: Mapping[Any, Any] | None) -> bool:
    """Return whether all files of a trial exist and have the sizes in the index.

    The file of a trial that is not in the index is read.
    """
    if not job.complete():
        return False
    if row is not None:
        return has_sizes(row, job.paths)
    try:
        Trial.open(job.paths.trial_file)
    except BadInputError:
        return False
    return True


@dataclass
class _Notes:
    """What is written into the folder after each outcome.

    For a failed trial, its traceback and its scene, if imported, into ``failures/``; the file of an
    earlier failure is removed if the trial succeeded. After every `INDEX_EVERY` trials the index,
    so that a run that was killed continues without reading the files of all trials that it made.
    """

    folder: Path
    jobs: Mapping[str, GenerateJob]
    rows: dict[str, Mapping[Any, Any]]
    new: int = 0

    def __call__(self, outcome: TaskOutcome[dict[str, Any] | None]) -> None:
        _note_failure(self.folder, outcome, self.jobs[outcome.key])
        if outcome.result is None:
            return
        self.rows[outcome.key] = outcome.result
        self.new += 1
        if self.new % INDEX_EVERY == 0:
            write_index(self.folder, as_table(list(self.rows.values())))


def _note_failure(folder: Path, outcome: TaskOutcome[Any], job: GenerateJob) -> None:
    path = folder / FAILURES / f"{outcome.key}.txt"
    if outcome.error is None:
        path.unlink(missing_ok=True)
        return
    text = f"{outcome.error}\ntries: {outcome.tries}\n\n{outcome.traceback}\n"
    if job.task.scene is not None:
        text += job.task.scene.to_json() + "\n"
    path.parent.mkdir(exist_ok=True)
    write_atomic(path, text.encode())


def _update_index(
    folder: Path, made: Mapping[str, dict[str, Any] | None]
) -> tuple[pd.DataFrame, dict[str, str]]:
    """Write the index unless it is up to date; return it, and problems by name of the trial.

    It is up to date if it has a digest file, lists exactly the trials of the folder with what was
    drawn for each, and none of them is in ``made``, which has the rows of new trials.
    """
    there = {(paths.split, paths.trial) for paths in find_trials(folder)}
    index = _known_index(folder)
    listed = set(zip(index["split"], index["trial"], strict=True))
    known = bool(index["drawn_room"].notna().all())
    if not made and has_digest(folder / INDEX) and listed == there and known:
        return index, {}
    known = index[~index["trial"].isin(made)].to_dict("records")
    table, problems = build_index(folder, [*known, *(row for row in made.values() if row)])
    write_index(folder, table)
    return table, problems


def _fix_settings(
    folder: Path, dataset: str, settings: GenerateSettings, tasks: Sequence[TrialTask]
) -> None:
    """Write the settings of the folder, or check that they equal the settings of earlier runs.

    Each split of a scenario must keep the presets, with all their values, of its first run.
    """
    # Imported late: loading the compiled renderer takes time.
    from physion.trials.making.make import RENDERER

    path = folder / SETTINGS
    made_by = {"engine": make_engine(settings.engine).name, "renderer": RENDERER}
    wanted = as_json({"dataset": dataset, "settings": settings.stored(), "made_by": made_by})
    presets = _presets_in_use(tasks)
    if path.is_file():
        known = read_json(path, dict[str, Any])
        before = known.pop("presets", {})
        differs = _differences(known, wanted)
        differs += [
            f"preset values of {name}"
            for name in presets
            if before.get(name, presets[name]) != presets[name]
        ]
        if differs or known.keys() != wanted.keys():
            raise BadInputError(
                f"{folder} was made with other settings: {', '.join(differs)}; see {path}, and "
                "choose another folder with --out or the same settings"
            )
        presets = {**before, **presets}
        if presets == before:
            return
    elif others := sorted(item.name for item in folder.iterdir() if item.name[0] != "."):
        raise BadInputError(
            f"{folder} is not empty and not a dataset (it contains {others[0]!r}); "
            "choose an empty or new folder"
        )
    text = json.dumps({**wanted, "presets": presets}, indent=1, sort_keys=True) + "\n"
    write_atomic(path, text.encode())


def _differences(
    known: Mapping[str, Any], wanted: Mapping[str, Any], prefix: str = ""
) -> list[str]:
    """Name each value that differs, with the known value and the wanted one."""
    found: list[str] = []
    for name, value in wanted.items():
        old = known.get(name)
        if isinstance(value, Mapping) and isinstance(old, Mapping):
            found += _differences(old, value, f"{prefix}{name}.")
        elif old != value:
            found.append(f"{prefix}{name} {old!r}, now {value!r}")
    return found


def _presets_in_use(tasks: Sequence[TrialTask]) -> dict[str, dict[str, str]]:
    """Return digests of the values of all presets in use, by split and scenario, then name."""
    found: dict[str, dict[str, str]] = {}
    for key, names in {(f"{t.split}/{t.scenario}", t.presets): t for t in tasks if t.presets}:
        for name in names:
            preset = get_preset(key.rpartition("/")[2], name)
            digest = stable_hash(json.dumps(as_record(preset.params), sort_keys=True))
            found.setdefault(key, {})[name] = f"{digest:032x}"
    return found


# Generation of a dataset in one call.


class GeneratedDataset(Dataset):
    """Dataset that `generate` made; ``report`` has the names of the trials made and kept."""

    def __init__(self, folder: Path, report: RunReport) -> None:
        super().__init__(folder)
        self.report = report


class FailedTrialsError(PhysionError):
    """Error for trials that could not be made; ``report`` names them and those that were made."""

    exit_code = 1

    def __init__(self, report: RunReport, asked: int, folder: Path) -> None:
        trial, reason = next(iter(report.failed.items()))
        super().__init__(
            f"{len(report.failed)} of {asked} trials could not be made, such as {trial!r}: "
            f"{reason}; the others are in {folder}, and the same call tries again"
        )
        self.report = report


def generate(
    folder: Path | str,
    scenario: str | Sequence[str] = "all",
    counts: Mapping[str, int] | int = 10,
    *,
    presets: Sequence[str] = (),
    whatif: Sequence[str] = (),
    pairs: Sequence[str] = (),
    name: str = "physion",
    settings: GenerateSettings | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> GeneratedDataset:
    """Sample scenes, simulate and render them, and write trials; existing trials are kept.

    An interrupted call is resumed by the same call. Equal arguments give equal bytes.

    Parameters
    ----------
    folder
        Folder of the dataset: new, empty, or one to resume or extend.
    scenario
        Name of a scenario, names of several (a list, or joined by commas), or ``all``.
    counts
        Trials per scenario by split (training, readout, testing, familiarization), or a number of
        testing trials.
    presets
        Names of presets that the trials of a scenario take in turn, or ``FILE.toml:NAME``; by
        default the published configurations.
    whatif
        Changes of `physion.trials.making.whatif.KINDS`: for each trial with labels, each of its
        variants is made, too. With one of ``CUES``, four trials with a cue
        (`physion.trials.making.cues`).
    pairs
        Kinds of `physion.trials.making.pairs.KINDS`: for each testing trial and each kind that it
        allows, two possible and two impossible movies are made, too.
    name
        Name of the dataset, part of the seed of every trial.
    settings
        How trials are chosen, rendered and stored.
    executor
        Where to run; by default one process per core, for which a script needs
        ``if __name__ == "__main__":``.
    progress
        Called with (stage, done, total) after every trial.

    Returns
    -------
    dataset
        All trials of the folder, including trials of earlier calls. Its ``report`` says which were
        made and kept.

    Raises
    ------
    UnknownNameError
        For an unknown scenario, split or preset.
    BadInputError
        If the folder was made with other settings or is not a dataset, or for presets of more than
        one scenario.
    FailedTrialsError
        If some trials could not be made. The others are in the folder, and the same call tries
        those that are missing again.
    """
    names = scenario.split(",") if isinstance(scenario, str) else list(scenario)
    if names == ["all"]:
        names = scenarios.names()
    if presets and len(names) != 1:
        raise BadInputError("presets need one scenario: each scenario has its own presets")
    planned = {"testing": counts} if isinstance(counts, int) else dict(counts)
    if not planned or min(planned.values()) < 1:
        raise BadInputError(f"counts must be 1 or more for each split, not {planned}")
    chosen = {names[0]: tuple(presets)} if presets else None
    tasks = plan_dataset(name, names, planned, chosen)
    if unknown := sorted(set(whatif) - {*KINDS, *CUES}):
        raise UnknownNameError("change", unknown[0], (*KINDS, *CUES))
    check_kinds(pairs)
    where, settings = Path(folder), settings or GenerateSettings()
    report = make_trials(where, tasks, settings, executor=executor, progress=progress)
    if whatif or pairs:
        made = Dataset(where)
        known = made.known_trials()
        there = [task for task in tasks if task.trial in known]
        changed: list[TrialTask] = []
        if whatif:
            labelled = [task.trial for task in there if settings.stores_labels(task.split)]
            changes, cues = (
                [kind for kind in whatif if (kind in CUES) == cued] for cued in (False, True)
            )
            changed += whatif_tasks(made, labelled, changes)
            changed += cue_tasks(made, labelled, cues, settings.engine)
        if pairs:
            tested = [task.trial for task in there if task.split == "testing"]
            changed += pair_tasks(made, tested, pairs, settings.engine, progress)
        if changed:
            more = make_trials(where, changed, settings, executor=executor, progress=progress)
            report = RunReport(
                [*report.made, *more.made], [*report.kept, *more.kept],
                {**report.failed, **more.failed}, more.index,
                {
                    f"pairs of {kind}": ("no trial allows them",)
                    for kind in pairs
                    if not any(f"{PAIR}.{kind}." in task.trial for task in changed)
                },
            )  # fmt: skip
            tasks = [*tasks, *changed]
    if report.failed:
        raise FailedTrialsError(report, len(tasks), Path(folder))
    return GeneratedDataset(Path(folder), report)
