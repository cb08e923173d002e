"""From tasks to files: sample or take a scene, simulate it, label it, render it, write it.

A trial is a pure function of its task and of the settings, and its files appear whole or not at
all. So nothing is remembered between runs: what is missing is made, in any order, by any number
of processes, and a killed run goes on where it stopped.
"""

from __future__ import annotations

import dataclasses
import errno
import json
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from physion.atomic import folder_lock, remove_leftovers, write_atomic
from physion.compute.executor import Executor, Outcome
from physion.errors import BadInputError, PhysionError
from physion.physics.engine import engines
from physion.scenes.sampling.preset import get_preset
from physion.scenes.sampling.registry import as_record
from physion.seeds import stable_hash
from physion.trials.index import build_index, read_index, write_index
from physion.trials.layout import CHOICES, FAILURES, INDEX, SETTINGS, find_trials
from physion.trials.making.plan import Job, Settings, Task, check_names
from physion.trials.sealed import read_sealed, write_sealed

Track = Callable[[Iterable[Outcome[Any]], str, int], Iterator[Outcome[Any]]]
"""Passes outcomes on and shows how far it is, as `physion.cli.output.track` does."""

HOPELESS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.EIO}
"""System errors that every later trial would meet too."""


@dataclass(frozen=True)
class Report:
    """What a run of `generate` did.

    ``made`` and ``kept`` name trials that were made and that were there already; ``failed`` says
    why, by name. ``index`` is the path of the index.
    """

    made: Sequence[str]
    kept: Sequence[str]
    failed: Mapping[str, str]
    index: Path

    @property
    def exit_code(self) -> int:
        """0, or 1 where a trial failed."""
        return 1 if self.failed else 0


def generate(
    folder: Path,
    tasks: Sequence[Task],
    settings: Settings | None = None,
    *,
    executor: Executor | None = None,
    track: Track | None = None,
    make: Callable[[Job], str] | None = None,
) -> Report:
    """Make all trials of ``tasks`` that ``folder`` does not hold yet, then its index.

    A trial that fails leaves its traceback in ``failures/`` and the others go on. Trials of
    other tasks in the folder are left alone and stay in the index. ``executor`` is by default
    one process a core; ``track`` shows progress; ``make`` replaces `make_trial`.

    Raises `BadInputError` where the folder cannot be written, holds something else, or was made
    with other settings, and `PhysionError` where the disk is full or another run is at work;
    what was finished before stays and the same call goes on.
    """
    if executor is None:
        from physion.compute.local import LocalExecutor

        executor = LocalExecutor()
    if make is None:
        # Engine and renderer are loaded by whoever makes trials, not by whoever plans them.
        from physion.trials.making.make import make_trial

        make = make_trial
    settings = settings or Settings()
    check_names(tasks)
    datasets = {task.dataset for task in tasks}
    if len(datasets) != 1:
        raise BadInputError(f"one folder takes one dataset, not {sorted(datasets) or 'none'}")
    jobs = {task.trial: Job(task, folder, settings) for task in tasks}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with folder_lock(folder):
            _fix_settings(folder, datasets.pop(), settings, tasks)
            remove_leftovers(folder)
            missing = {name: job for name, job in jobs.items() if not job.complete()}
            chosen, unchosen = _choose(folder, jobs, missing, settings, executor, track)
            made, failed = _run(folder, chosen, executor, track, make)
            problems = _update_index(folder, set(made))
    except OSError as error:
        raise BadInputError(f"cannot write into {folder}: {error.strerror or error}") from error
    kept = [name for name in jobs if name not in missing]
    return Report(made, kept, {**unchosen, **failed, **problems}, folder / INDEX)


def _choose(
    folder: Path,
    jobs: Mapping[str, Job],
    missing: Mapping[str, Job],
    settings: Settings,
    executor: Executor,
    track: Track | None,
) -> tuple[dict[str, Job], dict[str, str]]:
    """The missing jobs with their draws chosen, and why some could not be chosen."""
    groups: dict[Path, list[Task]] = {}
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

    choices, outcomes = choose_all(wanted, settings, executor, track)
    for name, outcome in outcomes.items():
        if outcome.errno in HOPELESS:
            raise PhysionError(f"cannot write into {folder}: {outcome.error}")
        if name in chosen:
            failed[name] = str(outcome.error)
            _note_failure(folder, outcome, chosen.pop(name))
    for name in choices.keys() & chosen.keys():
        job = chosen[name]
        chosen[name] = dataclasses.replace(job, task=choices[name].fill(job.task))
    return chosen, failed


def _run(
    folder: Path,
    jobs: Mapping[str, Job],
    executor: Executor,
    track: Track | None,
    make: Callable[[Job], str],
) -> tuple[list[str], dict[str, str]]:
    """Run the jobs; names of the trials made in the order of the jobs, and the failures."""
    made: set[str] = set()
    failed: dict[str, str] = {}
    outcomes = executor.map(make, jobs)
    try:
        for outcome in track(outcomes, "generating", len(jobs)) if track else outcomes:
            if outcome.error is None:
                made.add(outcome.key)
                (folder / FAILURES / f"{outcome.key}.txt").unlink(missing_ok=True)
                continue
            if outcome.errno in HOPELESS:
                raise PhysionError(
                    f"cannot write into {folder}: {outcome.error}; {len(made)} new trials are "
                    "whole, and the same command goes on from there"
                )
            failed[outcome.key] = outcome.error
            _note_failure(folder, outcome, jobs[outcome.key])
    finally:
        # Workers must have stopped before the folder is given to someone else.
        if isinstance(outcomes, Generator):
            outcomes.close()
    return [name for name in jobs if name in made], failed


def _note_failure(folder: Path, outcome: Outcome[Any], job: Job) -> None:
    """Leave the traceback and the scene, if it came from outside, where one can look at them."""
    text = f"{outcome.error}\ntries: {outcome.tries}\n\n{outcome.traceback}\n"
    if job.task.scene is not None:
        text += job.task.scene.to_json() + "\n"
    (folder / FAILURES).mkdir(exist_ok=True)
    write_atomic(folder / FAILURES / f"{outcome.key}.txt", text.encode())


def _update_index(folder: Path, made: set[str]) -> dict[str, str]:
    """Write the index unless it still holds; what is wrong with trials, by name.

    It holds if it names exactly the trials that are there and none of them was ``made`` just now.
    """
    there = {(paths.split, paths.trial) for paths in find_trials(folder)}
    try:
        index = read_index(folder)
    except BadInputError:
        index = None
    if (
        index is not None
        and not made
        and set(zip(index["split"], index["trial"], strict=True)) == there
    ):
        return {}
    known = None if index is None else index[~index["trial"].isin(made)]
    table, problems = build_index(folder, known)
    write_index(folder, table)
    return problems


def _fix_settings(folder: Path, dataset: str, settings: Settings, tasks: Sequence[Task]) -> None:
    """Write how the folder's trials are made, or raise where it was made another way.

    Each split of a scenario keeps the presets, with all their values, that it began with.
    """
    # Compiled code, which is loaded by whoever makes trials.
    from physion.trials.making.make import RENDERER

    path = folder / SETTINGS
    made_by = {"engine": engines.get("mujoco")().name, "renderer": RENDERER}
    plain = {"dataset": dataset, "settings": dataclasses.asdict(settings), "made_by": made_by}
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
    strangers = [item.name for item in folder.iterdir() if not item.name.startswith(".")]
    if strangers:
        raise BadInputError(
            f"{folder} is not empty and no dataset (it holds {sorted(strangers)[0]!r}); choose an "
            "empty or new folder"
        )
    write_sealed(path, {**wanted, "presets": presets})


def _presets_in_use(tasks: Sequence[Task]) -> dict[str, dict[str, str]]:
    """A digest of the values of every preset, by split and scenario."""
    found: dict[str, dict[str, str]] = {}
    for key, names in {(f"{t.split}/{t.scenario}", t.presets): t for t in tasks if t.presets}:
        for name in names:
            preset = get_preset(key.rpartition("/")[2], name)
            digest = stable_hash(json.dumps(as_record(preset.params), sort_keys=True))
            found.setdefault(key, {})[name] = f"{digest:032x}"
    return found
