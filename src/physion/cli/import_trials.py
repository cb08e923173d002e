"""Convert official HDF5 files and movies to a dataset of this package."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from physion.cli.official.report import print_report
from physion.cli.output import Stages
from physion.compute.local import LocalExecutor
from physion.trials.official.import_folder import import_official


@dataclass(frozen=True)
class Options:
    """Options of ``physion import``."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder with official files, at any depth."""
    out: Annotated[Path, tyro.conf.Positional]
    """Folder of the dataset: new, or one to resume."""
    name: str | None = None
    """Name of the dataset; default: the name in files of this package, else "imported"."""
    split: Literal["training", "readout", "testing", "familiarization"] | None = None
    """Split of the trials; default: the split in files of this package, else testing."""
    scenario: str | None = None
    """Scenario of all files; default: inferred from their names."""
    workers: int = os.cpu_count() or 1
    """Number of processes."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Import what is missing; return 1 if a file failed."""
    with Stages() as stages:
        report = import_official(
            options.folder,
            options.out,
            name=options.name,
            split=options.split,
            scenario=options.scenario,
            executor=LocalExecutor(workers=options.workers),
            progress=stages,
        )
    return print_report(report, options.json)
