"""Bring official HDF5 files and movies into a dataset of ours."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from physion.cli.official_files import print_report
from physion.cli.output import track
from physion.compute.local import LocalExecutor
from physion.trials.official.import_folder import import_official


@dataclass(frozen=True)
class Options:
    """What to import, and where to."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder with official files, at any depth."""
    out: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset to make or to go on with."""
    name: str | None = None
    """Name of the dataset; by default that of our own files, and "imported" for others."""
    split: Literal["training", "readout", "testing", "familiarization"] | None = None
    """Which part of the dataset the trials are; by default that of our own files, else testing."""
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
    return print_report(report, options.json)
