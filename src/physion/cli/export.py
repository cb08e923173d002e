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
from physion.errors import BadInputError


@dataclass(frozen=True)
class Options:
    """What to export, and how."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset."""
    out: Annotated[Path | None, tyro.conf.Positional] = None
    """Folder to write into; a card goes by default beside the index."""
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
    if options.layout == "card":
        return _card(options)
    if options.out is None:
        raise BadInputError(f"--layout {options.layout} needs a folder to write into")
    if options.layout == "webdataset":
        return _webdataset(options, options.out)
    return _official(options, options.out)


def _card(options: Options) -> int:
    from physion.trials.card import write_card

    if options.split or options.scenario:
        raise BadInputError("a card describes a whole dataset: leave out --split and --scenario")
    card = write_card(options.folder, options.out)
    paths = [card.readme, card.metadata]
    if options.json:
        print(json_module.dumps({"made": [str(path) for path in paths]}))
        return 0
    for path in paths:
        console.print(str(path), markup=False, soft_wrap=True)
    return 0


def _webdataset(options: Options, out: Path) -> int:
    from physion.trials.shards import export_shards

    report = export_shards(options.folder, out, split=options.split, scenario=options.scenario)
    if options.json:
        values = {"made": report.made, "samples": report.samples, "bytes": report.bytes}
        print(json_module.dumps(values | {"index": str(report.manifest)}, default=list))
        return 0
    kept = len(report.shards) - len(report.made)
    done = f"{report.samples} trials in {len(report.made)} new shards and {kept} kept"
    console.print(f"{done}: {report.manifest}", markup=False, soft_wrap=True)
    return 0


def _official(options: Options, out: Path) -> int:
    from physion.trials.official_export import export_official

    report = export_official(
        options.folder,
        out,
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
