"""Simulate official command logs and compare the outcomes with the recorded ones."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table

from physion.cli.output import Stages, console, write_text
from physion.compute.local import LocalExecutor
from physion.compute.progress import tracked
from physion.errors import BadInputError
from physion.physics.replay import Replay, ReplayRow, ReplayTask, replay_trial, summarise
from physion.scenes.tdw.read_logs import TrialSet, read_scenes

SHOWN_FAILURES = 5


@dataclass(frozen=True)
class Options:
    """Options of ``physion replay``."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder with official command logs, at any depth."""
    json: Path | None = None
    """Write the table, all trials and all failures to this file."""
    scenario: str | None = None
    """Replay this scenario alone."""
    limit: int | None = None
    """Replay only the first trials of each scenario, this many."""
    jitter: float = 1.0
    """Standard deviation, in millimetres, of the horizontal noise of the repeats."""
    repeats: int = 0
    """Jittered simulations of each trial, which measure the robustness of its outcome."""
    workers: int = os.cpu_count() or 1
    """Number of processes."""


def main(options: Options) -> int:
    """Replay and print the table; return 1 if a trial could not be imported or simulated."""
    if options.repeats < 0 or options.jitter < 0:
        raise BadInputError("--repeats and --jitter must not be negative")
    if options.json is not None and options.json.is_dir():
        raise BadInputError(f"--json {options.json} is a folder; give a file")
    logs = read_scenes(options.folder, options.scenario, options.limit)
    logs.require_trials()
    trials, copies = logs.unique()
    tasks = [ReplayTask(trial, options.jitter / 1000, options.repeats) for trial in trials]
    executor = LocalExecutor(workers=options.workers)
    replays: list[Replay] = []
    failures = [str(failure) for failure in logs.failures]
    results = executor.map(replay_trial, {task.trial.scene.name: task for task in tasks})
    with Stages() as stages:
        for outcome in tracked(results, "replaying", len(tasks), stages):
            if outcome.error is None:
                replays.append(outcome.value)
            else:
                failures.append(f"{outcome.key}: {outcome.error}")
    order = {task.trial.scene.name: position for position, task in enumerate(tasks)}
    replays.sort(key=lambda replay: order[replay.name])
    rows = summarise(replays)
    _print(rows, copies, logs, failures)
    if options.json:
        write_text(options.json, _as_json(rows, replays, copies, logs, failures))
        print(options.json)
    return 1 if failures else 0


def _print(rows: Sequence[ReplayRow], copies: int, logs: TrialSet, failures: list[str]) -> None:
    table = Table(title="Simulated outcomes compared with the recorded ones")
    for column in (
        "scenario",
        "trials",
        "base",
        "agree",
        "ceiling",
        "AUC",
        "frames",
        "ms",
        "speed",
    ):
        table.add_column(column, justify="left" if column == "scenario" else "right")
    for row in rows:
        table.add_row(
            row.scenario,
            str(row.trials),
            _number(row.base_rate),
            _number(row.agreement),
            _number(row.ceiling),
            _number(row.auc),
            f"±{row.frame_difference:.0f}" if row.frame_difference >= 0 else "-",
            f"{row.milliseconds:.0f}",
            f"{row.real_time:.0f}x",
        )
    console.print(table)
    console.print(
        "base: frequency of the more frequent outcome; frames: median difference of first contact; "
        "ms: processor time per trial; speed: times real time"
    )
    unknown = ", ".join(f"{name} x{count}" for name, count in logs.unknown.items()) or "none"
    console.print(f"duplicates left out: {copies}; unknown commands: {unknown}")
    notes = sum(len(trial.notes) for trial in logs.trials)
    console.print(f"notes on imported trials: {notes}; failures: {len(failures)}")
    for failure in failures[:SHOWN_FAILURES]:
        console.print(f"  {failure}", markup=False, soft_wrap=True)
    if len(failures) > SHOWN_FAILURES:
        console.print(f"  ... and {len(failures) - SHOWN_FAILURES} more (--json lists all)")


def _number(value: float) -> str:
    return f"{value:.3f}" if value == value else "-"


def _as_json(
    rows: Sequence[ReplayRow],
    replays: Sequence[Replay],
    copies: int,
    logs: TrialSet,
    failures: list[str],
) -> str:
    def as_dict(thing: Replay | ReplayRow) -> dict[str, object]:
        values = dataclasses.asdict(thing)
        return {key: None if value != value else value for key, value in values.items()}

    content = {
        "scenarios": [as_dict(row) for row in rows],
        "trials": [as_dict(replay) for replay in replays],
        "duplicates": copies,
        "unknown_commands": dict(logs.unknown),
        "failures": failures,
        "notes": {t.scene.name: list(t.notes) for t in logs.trials if t.notes},
    }
    return json.dumps(content, indent=1) + "\n"
