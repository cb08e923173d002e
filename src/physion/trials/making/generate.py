"""Generation of a dataset: choose scenes, then simulate, label, render and write every trial.

A trial is a pure function of its task and of the settings, and its files are written atomically.
Therefore no state is kept between runs: a run makes whatever is missing, in any order and with any
number of processes, and an interrupted run is continued by the same call.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from physion.compute.run_tasks import FATAL_ERRNOS, RunReport, run_tasks
from physion.compute.tasks import Executor, Progress, TaskOutcome, workers_kept
from physion.core.errors import BadInputError, PhysionError
from physion.core.files import (
    folder_for_writing,
    has_digest,
    read_sealed,
    remove_leftovers,
    write_atomic,
    write_sealed,
)
from physion.core.seeds import stable_hash
from physion.physics.engine import make_engine
from physion.scenes.sampling.build import as_record, scenarios
from physion.scenes.sampling.sample import get_preset
from physion.trials.dataset import Dataset
from physion.trials.index import (
    CHOICES,
    FAILURES,
    FILES,
    INDEX,
    SETTINGS,
    build_index,
    describe_mixed_versions,
    find_trials,
    has_sizes,
    read_index,
    write_index,
)
from physion.trials.making.plan import (
    GenerateJob,
    GenerateSettings,
    TrialTask,
    check_names,
    plan_dataset,
)
from physion.trials.trial_file import Trial


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

    If a trial fails, its traceback is written to ``failures/`` and the others go on. Trials of
    other tasks in the folder are not changed and stay in the index.

    Parameters
    ----------
    folder
        Folder of the dataset; made if it does not exist.
    tasks
        Trials to make, all of one dataset.
    settings
        How to choose, render and store trials; must be those of earlier runs in the folder.
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
        listed = _listed_files(folder)
        missing = {n: job for n, job in jobs.items() if not _is_made(job, listed.get(n))}
        chosen, unchosen = _choose(folder, jobs, missing, settings, executor, progress)
        made, failed = run_tasks(
            make,
            chosen,
            folder=folder,
            what="generating",
            executor=executor,
            progress=progress,
            on_outcome=lambda outcome: _note_outcome(folder, outcome, chosen[outcome.key]),
        )
        problems = _update_index(folder, set(made))
        notes = _mixed_versions(folder)
    kept = [name for name in jobs if name not in missing and name not in problems]
    return RunReport(list(made), kept, {**unchosen, **failed, **problems}, folder / INDEX, notes)


def _listed_files(folder: Path) -> dict[str, dict[Any, Any]]:
    """Return paths and sizes of all files by trial according to the index; none without one."""
    try:
        index = read_index(folder)
    except BadInputError:
        return {}
    columns = ["trial", "split", "scenario", *FILES, *(f"{name}_bytes" for name in FILES)]
    return {str(row["trial"]): row for row in index[columns].to_dict("records")}


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


def _mixed_versions(folder: Path) -> dict[str, tuple[str, ...]]:
    """Return a note if trials of several versions of the package are in the folder."""
    note = describe_mixed_versions(read_index(folder))
    return {str(folder): (note,)} if note else {}


def _choose(
    folder: Path,
    jobs: Mapping[str, GenerateJob],
    missing: Mapping[str, GenerateJob],
    settings: GenerateSettings,
    executor: Executor,
    progress: Progress | None,
) -> tuple[dict[str, GenerateJob], dict[str, str]]:
    """Return the missing jobs with their scenes chosen, and the reasons of failures by name."""
    groups: dict[Path, list[TrialTask]] = {}
    for job in jobs.values():
        if job.task.presets:
            path = folder / CHOICES / f"{job.task.split}_{job.task.scenario}.json"
            groups.setdefault(path, []).append(job.task)
    wanted = {
        path: tasks
        for path, tasks in groups.items()
        if any(task.trial in missing for task in tasks)
    }
    chosen, failed = dict(missing), dict[str, str]()
    if not wanted:
        return chosen, failed
    from physion.trials.making.choose import choose_all

    choices, outcomes = choose_all(wanted, settings, executor, progress)
    for name, outcome in outcomes.items():
        if outcome.errno in FATAL_ERRNOS:
            raise PhysionError(f"cannot write into {folder}: {outcome.error}")
        if name in chosen:
            failed[name] = str(outcome.error)
            _note_outcome(folder, outcome, chosen.pop(name))
    for name in choices.keys() & chosen.keys():
        job = chosen[name]
        chosen[name] = dataclasses.replace(job, task=choices[name].fill(job.task))
    return chosen, failed


def _note_outcome(folder: Path, outcome: TaskOutcome[Any], job: GenerateJob) -> None:
    """Write the traceback of a failed trial and its scene, if imported, into ``failures/``.

    The file of an earlier failure is removed if the trial succeeded.
    """
    path = folder / FAILURES / f"{outcome.key}.txt"
    if outcome.error is None:
        path.unlink(missing_ok=True)
        return
    text = f"{outcome.error}\ntries: {outcome.tries}\n\n{outcome.traceback}\n"
    if job.task.scene is not None:
        text += job.task.scene.to_json() + "\n"
    path.parent.mkdir(exist_ok=True)
    write_atomic(path, text.encode())


def _update_index(folder: Path, made: set[str]) -> dict[str, str]:
    """Write the index unless it is up to date; return problems by name of the trial.

    It is up to date if it has a SHA-256, lists exactly the trials of the folder, and none of them
    is in ``made``.
    """
    there = {(paths.split, paths.trial) for paths in find_trials(folder)}
    try:
        index = read_index(folder)
    except BadInputError:
        index = None
    if (
        index is not None
        and not made
        and has_digest(folder / INDEX)
        and set(zip(index["split"], index["trial"], strict=True)) == there
    ):
        return {}
    known = None if index is None else index[~index["trial"].isin(made)]
    table, problems = build_index(folder, known)
    write_index(folder, table)
    return problems


def _fix_settings(
    folder: Path, dataset: str, settings: GenerateSettings, tasks: Sequence[TrialTask]
) -> None:
    """Write the settings of the folder, or check that they are those of earlier runs.

    Each split of a scenario must keep the presets, with all their values, of its first run.
    """
    # Imported late: loading the compiled renderer takes time.
    from physion.trials.making.make import RENDERER

    path = folder / SETTINGS
    made_by = {"engine": make_engine(settings.engine).name, "renderer": RENDERER}
    plain = {"dataset": dataset, "settings": settings.stored(), "made_by": made_by}
    wanted = json.loads(json.dumps(plain))
    presets = _presets_in_use(tasks)
    if path.is_file():
        known = read_sealed(path)
        before = known.pop("presets", {})
        differs = [name for name in wanted if known.get(name) != wanted[name]]
        differs += [name for name in presets if before.get(name, presets[name]) != presets[name]]
        if differs or known.keys() != wanted.keys():
            raise BadInputError(
                f"{folder} was made with another dataset name, other settings or other versions "
                f"({', '.join(differs)}), see {path}; choose another folder"
            )
        presets = {**before, **presets}
        if presets == before:
            return
    if path.is_file():
        write_sealed(path, {**wanted, "presets": presets})
        return
    others = [item.name for item in folder.iterdir() if not item.name.startswith(".")]
    if others:
        raise BadInputError(
            f"{folder} is not empty and not a dataset (it contains {sorted(others)[0]!r}); "
            "choose an empty or new folder"
        )
    write_sealed(path, {**wanted, "presets": presets})


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


def generate(
    folder: Path | str,
    scenario: str | Sequence[str] = "all",
    counts: Mapping[str, int] | int = 10,
    *,
    presets: Sequence[str] = (),
    name: str = "physion",
    settings: GenerateSettings | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Dataset:
    """Sample scenes, simulate and render them, and write trials; existing trials are kept.

    An interrupted call is resumed by the same call. Equal arguments give equal bytes.

    Parameters
    ----------
    folder
        Folder of the dataset: new, empty, or one to resume or extend.
    scenario
        Name of a scenario, names of several, or ``all``.
    counts
        Trials per scenario by split (training, readout, testing, familiarization), or a number of
        testing trials.
    presets
        Names of presets that the trials of a scenario take in turn, or ``FILE.toml:NAME``; by
        default the published configurations.
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
        All trials of the folder, including those of earlier calls.

    Raises
    ------
    UnknownNameError
        For an unknown scenario, split or preset.
    BadInputError
        If the folder was made with other settings or is not a dataset, or for presets of more than
        one scenario.
    PhysionError
        If some trials could not be made. The others are in the folder, and the same call tries
        those that are missing again.
    """
    names = [scenario] if isinstance(scenario, str) else list(scenario)
    if names == ["all"]:
        names = scenarios.names()
    if presets and len(names) != 1:
        raise BadInputError("presets need one scenario: each scenario has its own presets")
    planned = {"testing": counts} if isinstance(counts, int) else dict(counts)
    if not planned or min(planned.values()) < 1:
        raise BadInputError(f"counts must be 1 or more for each split, not {planned}")
    chosen = {names[0]: tuple(presets)} if presets else None
    tasks = plan_dataset(name, names, planned, chosen)
    report = make_trials(Path(folder), tasks, settings, executor=executor, progress=progress)
    if report.failed:
        trial, reason = next(iter(report.failed.items()))
        raise PhysionError(
            f"{len(report.failed)} of {len(tasks)} trials could not be made, such as {trial!r}: "
            f"{reason}; the others are in {folder}, and the same call tries again"
        )
    return Dataset(folder)
