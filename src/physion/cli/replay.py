"""Simulate official command logs and compare the outcomes with the recorded ones.

One row for each scenario and engine. With --repeats 8, eight more simulations of each trial under
jitter give the probability of the recorded outcome: its mean (jittered), Brier and log score, and
the ceiling, the probability that two such runs agree. final is the median distance between
simulated and recorded final position of the agent in metres.
docs/explanation/physics.md describes all columns.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import pandas as pd
import tyro

from physion.cli.output import Stages, console, print_line, text_table, write_text
from physion.compute.run_tasks import ExecutorSettings
from physion.compute.tasks import Executor, tracked
from physion.core.errors import BadInputError
from physion.core.version import MADE_WITH
from physion.data.official import PACKAGED, read_official_trials
from physion.physics.engine import DEFAULT_ENGINE, can_simulate, engines
from physion.physics.replay import Replay, ReplayRow, ReplayTask, replay_trial, summarise
from physion.scenes.tdw.read_logs import TrialSet

SHOWN_FAILURES = 5
COLUMNS = {
    "scenario": "scenario",
    "engine": "engine",
    "trials": "trials",
    "base_rate": "base",
    "agreement": "agree",
    "jittered_agreement": "jittered",
    "ceiling": "ceiling",
    "brier": "Brier",
    "log_score": "log",
    "auc": "AUC",
    "frame_difference": "frames",
    "final_error": "final",
    "milliseconds": "ms",
    "real_time": "speed",
}
"""Columns of the table by the field of `ReplayRow`."""
LEGEND = {
    "base": "fraction of the more frequent recorded outcome",
    "agree": "fraction of trials whose simulated outcome is the recorded one",
    "jittered": "the same of jittered runs",
    "ceiling": "probability that two jittered runs of a trial agree",
    "Brier": "mean of (1 - k/n)², where k of the n jittered runs have the recorded outcome",
    "log": "mean of log((k + .5) / (n + 1)) with these k and n",
    "AUC": "area under the curve of the smallest cloth gap",
    "frames": "median difference of first contact",
    "final": "median distance in metres of the agent's final position from the recorded one",
    "ms": "processor time per trial",
    "speed": "times real time",
}
"""Meaning of the columns (docs/explanation/physics.md)."""


@dataclass(frozen=True)
class ReplayResult:
    """All that was replayed.

    ``copies`` counts duplicates left out, ``skipped`` trials with cloth left out for an engine
    without it.
    """

    rows: Sequence[ReplayRow]
    replays: Sequence[Replay]
    copies: int
    skipped: int
    failures: list[str]


@dataclass(frozen=True)
class Options:
    """Options of ``physion replay``."""

    folder: Annotated[Path, tyro.conf.Positional] = Path(PACKAGED)
    """Folder with official command logs, at any depth, or made by physion import; official stands
    for the scenes of the package."""
    json: Path | None = None
    """Write the table, all trials and all failures to this file."""
    scenario: str | None = None
    """Replay only this scenario."""
    limit: int | None = None
    """Replay only the first trials of each scenario, this many."""
    jitter: float = 1.0
    """Standard deviation, in millimetres, of the horizontal noise of the repeats."""
    repeats: int = 0
    """Jittered simulations of each trial, from which the probability of its recorded outcome and
    the ceiling are computed; 0 leaves these columns out."""
    engines: Annotated[tuple[str, ...], tyro.conf.arg(aliases=("--engine",))] = (DEFAULT_ENGINE,)
    """Engines that simulate the trials (see physion ls engines), a row for each: physion,mujoco."""
    compute: Annotated[ExecutorSettings, tyro.conf.arg(name="")] = field(
        default_factory=ExecutorSettings
    )
    """Where tasks run, and their limits."""


def main(options: Options) -> int:
    """Replay and print the table; return 1 if a trial could not be imported or simulated."""
    if options.repeats < 0 or options.jitter < 0:
        raise BadInputError("--repeats and --jitter must not be negative")
    if options.json is not None and options.json.is_dir():
        raise BadInputError(f"--json {options.json} is a folder; give a file")
    logs = read_official_trials(options.folder, options.scenario, options.limit)
    logs.require_trials()
    trials, copies = logs.unique()
    names = _engine_names(options.engines)
    tasks = {
        f"{trial.scene.name} ({name})": ReplayTask(
            trial, options.jitter / 1000, options.repeats, name
        )
        for name in names
        for trial in trials
        if can_simulate(name, trial.scene)
    }
    replays, failures = _replay(tasks, options.compute.open())
    failures = [str(failure) for failure in logs.failures] + failures
    rows = summarise(replays)
    result = ReplayResult(rows, replays, copies, len(trials) * len(names) - len(tasks), failures)
    _print(result, logs)
    if options.json:
        write_text(options.json, _as_json(result, logs))
        print(options.json)
    return 1 if failures else 0


def _engine_names(given: Sequence[str]) -> list[str]:
    """Return the engines to use, which may be separated by commas; each must exist."""
    names = list(dict.fromkeys(name for text in given for name in text.split(",") if name))
    for name in names:
        engines.get(name)
    if not names:
        raise BadInputError(f"--engines needs at least one of {', '.join(engines.names())}")
    return names


def _replay(tasks: Mapping[str, ReplayTask], executor: Executor) -> tuple[list[Replay], list[str]]:
    """Run the tasks; return the replays, by scenario, engine and log, and the failures."""
    results = executor.map(replay_trial, tasks)
    done: dict[str, Replay] = {}
    failures = []
    with Stages() as stages:
        for outcome in tracked(results, "replaying", len(tasks), stages):
            if outcome.error is None:
                done[outcome.key] = outcome.value
            else:
                failures.append(f"{outcome.key}: {outcome.error}")
    scenarios = list(dict.fromkeys(task.trial.scene.scenario for task in tasks.values()))
    replays = [done[key] for key in tasks if key in done]
    return sorted(replays, key=lambda replay: scenarios.index(replay.scenario)), failures


def _print(result: ReplayResult, logs: TrialSet) -> None:
    table = pd.DataFrame([dataclasses.asdict(row) for row in result.rows], columns=[*COLUMNS])
    table = table.rename(columns=COLUMNS).round({"ms": 0, "speed": 0})
    if table["engine"].nunique() < 2:
        del table["engine"]
    # Without jitter, and without cloth, some columns are empty.
    table = table.dropna(axis="columns", how="all")
    title = "Simulated outcomes compared with the recorded ones"
    print_line(text_table(table, title))
    console.print("; ".join(f"{name}: {LEGEND[name]}" for name in table if name in LEGEND))
    unknown = ", ".join(f"{name} x{count}" for name, count in logs.unknown.items()) or "none"
    console.print(f"duplicates left out: {result.copies}; unknown commands: {unknown}")
    if result.skipped:
        console.print(f"left out, because the engine has no cloth: {result.skipped}")
    notes = sum(len(trial.notes) for trial in logs.trials)
    failures = result.failures
    console.print(f"notes on imported trials: {notes}; failures: {len(failures)}")
    for failure in failures[:SHOWN_FAILURES]:
        print_line(f"  {failure}")
    if len(failures) > SHOWN_FAILURES:
        console.print(f"  ... and {len(failures) - SHOWN_FAILURES} more (--json lists all)")


def _as_json(result: ReplayResult, logs: TrialSet) -> str:
    def as_dict(thing: Replay | ReplayRow) -> dict[str, object]:
        values = dataclasses.asdict(thing)
        return {key: None if value != value else value for key, value in values.items()}

    content = {
        "package": MADE_WITH,
        "scenarios": [as_dict(row) for row in result.rows],
        "trials": [as_dict(replay) for replay in result.replays],
        "duplicates": result.copies,
        "without_cloth": result.skipped,
        "unknown_commands": dict(logs.unknown),
        "failures": result.failures,
        "notes": {t.scene.name: list(t.notes) for t in logs.trials if t.notes},
    }
    return json.dumps(content, indent=1) + "\n"
