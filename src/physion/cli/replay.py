"""Simulate official command logs and compare with the outcomes that were recorded."""

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

from physion.cli.output import console, track, write_text
from physion.compute.local import LocalExecutor
from physion.errors import BadInputError
from physion.physics.replay import Replay, ReplayRow, ReplayTask, replay_trial, summarise
from physion.scenes.tdw.read_logs import TrialSet, read_scenes

SHOWN_FAILURES = 5


@dataclass(frozen=True)
class Options:
    """How to replay."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder with official command logs, at any depth."""
    json: Path | None = None
    """Write the table, every trial and every failure to this file."""
    scenario: str | None = None
    """Only this scenario."""
    limit: int | None = None
    """Only the first so many trials of each scenario."""
    jitter: float = 1.0
    """Sideways noise of the repeats: standard deviation in millimetres."""
    repeats: int = 0
    """Jittered runs of each trial, for the agreement of a scene with itself."""
    workers: int = os.cpu_count() or 1
    """Processes."""


def main(options: Options) -> int:
    """Replay, print the table; 1 if a trial could not be imported or simulated."""
    if options.repeats < 0 or options.jitter < 0:
        raise BadInputError("--repeats and --jitter must not be below 0")
    if options.json is not None and options.json.is_dir():
        raise BadInputError(f"--json {options.json} is a folder; give a file")
    found = read_scenes(options.folder, options.scenario, options.limit)
    found.require_trials()
    trials, copies = found.unique()
    tasks = [ReplayTask(trial, options.jitter / 1000, options.repeats) for trial in trials]
    executor = LocalExecutor(workers=options.workers)
    replays: list[Replay] = []
    failures = [str(failure) for failure in found.failures]
    results = executor.map(replay_trial, {task.trial.scene.name: task for task in tasks})
    for outcome in track(results, "replaying", len(tasks)):
        if outcome.error is None:
            replays.append(outcome.value)
        else:
            failures.append(f"{outcome.key}: {outcome.error}")
    order = {task.trial.scene.name: position for position, task in enumerate(tasks)}
    replays.sort(key=lambda replay: order[replay.name])
    rows = summarise(replays)
    _print(rows, copies, found, failures)
    if options.json:
        write_text(options.json, _as_json(rows, replays, copies, found, failures))
        print(options.json)
    return 1 if failures else 0


def _print(rows: Sequence[ReplayRow], copies: int, found: TrialSet, failures: list[str]) -> None:
    table = Table(title="Simulated outcome against the recorded one")
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
        "base: share of the commoner outcome; frames: median difference of first contact; "
        "ms: processor time a trial; speed: times real time"
    )
    unknown = ", ".join(f"{name} x{count}" for name, count in found.unknown.items()) or "none"
    console.print(f"duplicates left out: {copies}; unknown commands: {unknown}")
    notes = sum(len(trial.notes) for trial in found.trials)
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
    found: TrialSet,
    failures: list[str],
) -> str:
    def plain(thing: Replay | ReplayRow) -> dict[str, object]:
        values = dataclasses.asdict(thing)
        return {key: None if value != value else value for key, value in values.items()}

    content = {
        "scenarios": [plain(row) for row in rows],
        "trials": [plain(replay) for replay in replays],
        "duplicates": copies,
        "unknown_commands": dict(found.unknown),
        "failures": failures,
        "notes": {t.scene.name: list(t.notes) for t in found.trials if t.notes},
    }
    return json.dumps(content, indent=1) + "\n"
