"""Bring official HDF5 files and movies into a dataset of ours."""

from __future__ import annotations

import json as json_module
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from physion.cli.output import console, track
from physion.compute.local import LocalExecutor
from physion.trials.official_import import import_official

SHOWN_NOTES = 5


@dataclass(frozen=True)
class Options:
    """What to import, and where to."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder with official files, at any depth."""
    out: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset to make or to go on with."""
    name: str = "imported"
    """Name of the dataset."""
    split: Literal["training", "readout", "testing", "familiarization"] = "testing"
    """Which part of the dataset the trials are."""
    scenario: str | None = None
    """The scenario of all files; by default the one that their names say."""
    workers: int = os.cpu_count() or 1
    """Processes."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Import what is missing; 1 if a file failed."""
    report = import_official(
        options.folder,
        options.out,
        name=options.name,
        split=options.split,
        scenario=options.scenario,
        executor=LocalExecutor(workers=options.workers),
        track=track,
    )
    if options.json:
        values = {"made": report.made, "kept": report.kept, "failed": dict(report.failed)}
        values |= {"notes": dict(report.notes), "index": str(report.index)}
        print(json_module.dumps(values))
        return report.exit_code
    for name, reason in report.failed.items():
        console.print(f"failed: {name}: {reason}", markup=False, soft_wrap=True)
    notes = [f"{name}: {note}" for name, found in report.notes.items() for note in found]
    for note in notes[:SHOWN_NOTES]:
        console.print(f"note: {note}", markup=False, soft_wrap=True)
    if len(notes) > SHOWN_NOTES:
        more = len(notes) - SHOWN_NOTES
        console.print(f"... and {more} more notes (--json lists all)", markup=False)
    done = f"{len(report.made)} made, {len(report.kept)} kept, {len(report.failed)} failed"
    console.print(f"{done}: {report.index}", markup=False, soft_wrap=True)
    return report.exit_code
