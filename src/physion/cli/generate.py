"""Sample scenes, simulate and render them, and write trials; existing trials are kept."""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import tyro

from physion.cli.output import Stages, console
from physion.compute.run_tasks import ExecutorSettings, RunReport
from physion.core.errors import BadInputError
from physion.scenes.sampling.build import scenarios
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import FULL_COUNTS, SPLITS, GenerateSettings, plan_dataset


@dataclass(frozen=True)
class Options:
    """Options of ``physion generate``."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset: new, empty, or one to resume."""
    scenario: str = "all"
    """Name of a scenario, or all."""
    split: Literal["training", "readout", "testing", "familiarization", "all"] = "testing"
    """Split to generate; all with --full generates the sets of the study."""
    count: int = 10
    """Trials per scenario."""
    full: bool = False
    """Use the sizes of the study instead of --count: training 2000, readout 1000, testing 150,
    familiarization 10 per scenario."""
    presets: tuple[str, ...] = ()
    """Presets that are used in turn (see physion ls presets), or FILE.toml:NAME; default: the
    published configurations. Requires a --scenario."""
    name: str = "physion"
    """Name of the dataset, part of the seed of every trial."""
    settings: Annotated[GenerateSettings, tyro.conf.arg(name="")] = field(
        default_factory=GenerateSettings
    )
    """How trials are chosen, rendered and stored."""
    compute: Annotated[ExecutorSettings, tyro.conf.arg(name="")] = field(
        default_factory=ExecutorSettings
    )
    """Where tasks run, and their limits."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Make the missing trials; 1 if one failed."""
    names = scenarios.names() if options.scenario == "all" else [options.scenario]
    if options.count < 1:
        raise BadInputError(f"--count must be 1 or more, not {options.count}")
    for name in names:
        scenarios.get(name)
    if options.presets and options.scenario == "all":
        raise BadInputError("--presets needs one --scenario: each scenario has its own presets")
    splits = SPLITS if options.split == "all" else (options.split,)
    counts = {split: FULL_COUNTS[split] if options.full else options.count for split in splits}
    presets = {options.scenario: options.presets} if options.presets else None
    with Stages() as stages:
        report = make_trials(
            options.folder,
            plan_dataset(options.name, names, counts, presets),
            options.settings,
            executor=options.compute.open(),
            progress=stages,
        )
    _print(report, options.json)
    return report.exit_code


def _print(report: RunReport, json: bool) -> None:
    if json:
        values = {"made": report.made, "kept": report.kept, "failed": dict(report.failed)}
        values |= {"notes": dict(report.notes), "index": str(report.index)}
        print(json_module.dumps(values, default=list))
        return
    for name, reason in report.failed.items():
        console.print(f"failed: {name}: {reason}", markup=False, soft_wrap=True)
    for name, notes in report.notes.items():
        for note in notes:
            console.print(f"note: {name}: {note}", markup=False, soft_wrap=True)
    done = f"{len(report.made)} made, {len(report.kept)} kept, {len(report.failed)} failed"
    console.print(f"{done}: {report.index}", markup=False, soft_wrap=True)
