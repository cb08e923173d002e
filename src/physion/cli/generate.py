"""Sample scenes, simulate, render, and write trials. What is there already is kept."""

from __future__ import annotations

import json as json_module
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from physion.cli.output import console, track
from physion.compute.local import LocalExecutor
from physion.errors import BadInputError
from physion.scenes.scenarios import scenarios
from physion.trials.generate import generate
from physion.trials.plan import Settings, plan_dataset


@dataclass(frozen=True)
class Options:
    """What to make, and where."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset; new, empty, or one to go on with."""
    scenario: str = "all"
    """A scenario, or all."""
    split: Literal["training", "readout", "testing", "familiarization"] = "testing"
    """Which part of the dataset."""
    count: int = 10
    """Trials a scenario."""
    name: str = "physion"
    """Name of the dataset: another name draws other trials."""
    size: int = 256
    """Pixels a side."""
    look: Literal["redyellow", "free"] = "redyellow"
    """Red agent and yellow patient, or free colours with the map."""
    passes: tuple[str, ...] = ()
    """Image passes to store: color depth normals ids flow. Any can be rendered again later."""
    compatible: bool = False
    """Compress with gzip, which every HDF5 reader knows, in place of zstd."""
    workers: int = os.cpu_count() or 1
    """Processes."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Make the missing trials; 1 if one failed."""
    names = scenarios.names() if options.scenario == "all" else [options.scenario]
    if options.count < 1:
        raise BadInputError(f"--count must be 1 or more, not {options.count}")
    for name in names:
        scenarios.get(name)
    report = generate(
        options.folder,
        plan_dataset(options.name, names, {options.split: options.count}),
        Settings(options.size, options.size, options.look, options.passes, options.compatible),
        executor=LocalExecutor(workers=options.workers),
        track=track,
    )
    if options.json:
        values = {"made": report.made, "kept": report.kept, "failed": dict(report.failed)}
        print(json_module.dumps(values | {"index": str(report.index)}, default=list))
        return report.exit_code
    for name, reason in report.failed.items():
        console.print(f"failed: {name}: {reason}", markup=False, soft_wrap=True)
    done = f"{len(report.made)} made, {len(report.kept)} kept, {len(report.failed)} failed"
    console.print(f"{done}: {report.index}", markup=False, soft_wrap=True)
    return report.exit_code
