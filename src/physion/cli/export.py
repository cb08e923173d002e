"""Write a dataset in the layouts of others: the original study's, webdataset, or a dataset card."""

from __future__ import annotations

import json as json_module
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from physion.cli.output import console, track
from physion.compute.local import LocalExecutor


@dataclass(frozen=True)
class Options:
    """What to export, and how."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset."""
    out: Annotated[Path, tyro.conf.Positional]
    """Folder to write into."""
    layout: Literal["official", "webdataset", "card"] = "official"
    """HDF5 files and PhysionTest-Core folders; tar shards; or a card with Croissant metadata."""
    split: Literal["training", "readout", "testing", "familiarization"] | None = None
    """Only this part of the dataset."""
    scenario: str | None = None
    """Only this scenario."""
    workers: int = os.cpu_count() or 1
    """Processes."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Export what is missing; 1 if a trial failed."""
    if options.layout == "official":
        return _official(options)
    executor = LocalExecutor(workers=options.workers)
    if options.layout == "webdataset":
        from physion.trials.shards import export_shards

        written = export_shards(
            options.folder,
            options.out,
            split=options.split,
            scenario=options.scenario,
            executor=executor,
            track=track,
        )
    else:
        from physion.trials.card import write_card

        written = write_card(
            options.folder, options.out, split=options.split, scenario=options.scenario
        )
    if options.json:
        print(json_module.dumps({"written": [str(path) for path in written]}))
        return 0
    for path in written:
        console.print(str(path), markup=False, soft_wrap=True)
    return 0


def _official(options: Options) -> int:
    from physion.trials.official_export import export_official

    report = export_official(
        options.folder,
        options.out,
        split=options.split,
        scenario=options.scenario,
        executor=LocalExecutor(workers=options.workers),
        track=track,
    )
    if options.json:
        values = {"made": report.made, "kept": report.kept, "failed": dict(report.failed)}
        print(json_module.dumps(values | {"index": str(report.index)}))
        return report.exit_code
    for name, reason in report.failed.items():
        console.print(f"failed: {name}: {reason}", markup=False, soft_wrap=True)
    done = f"{len(report.made)} made, {len(report.kept)} kept, {len(report.failed)} failed"
    console.print(f"{done}: {report.index}", markup=False, soft_wrap=True)
    return report.exit_code
