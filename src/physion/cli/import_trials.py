"""Convert official HDF5 files and movies to a dataset, or a checkout of the study to its data.

A checkout, which has human_accuracy-*.csv and command logs, becomes a folder with scenes, recorded
outcomes, labels, answers of people and published tables. --scenes, --humans and replay take it in
place of `official`.
"""

from __future__ import annotations

import dataclasses
import json as json_module
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from physion.cli.output import Stages, print_line, print_report
from physion.core.errors import BadInputError


@dataclass(frozen=True)
class Options:
    """Options of ``physion import``."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder with official HDF5 files or movies at any depth, or a checkout of the study."""
    out: Annotated[Path, tyro.conf.Positional]
    """Folder to write: new, or a dataset to resume."""
    name: str = "imported"
    """Name of the dataset."""
    split: Literal["training", "readout", "testing", "familiarization"] | None = None
    """Split of the trials; default: as in metadata.json next to the files, else testing."""
    scenario: str | None = None
    """Scenario of all files; default: inferred from their names."""
    workers: int = os.cpu_count() or 1
    """Number of processes."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Import what is missing; return 1 if a file failed."""
    from physion.data.make import is_checkout

    if is_checkout(options.folder):
        return _checkout(options)
    from physion.compute.local import LocalExecutor
    from physion.trials.official.import_folder import import_official

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


def _checkout(options: Options) -> int:
    from physion.data.make import make_official

    for name in ("split", "scenario"):
        if getattr(options, name) is not None:
            raise BadInputError(f"--{name} does not apply to a checkout of the study: leave it out")
    made = make_official(options.folder, options.out)
    if options.json:
        print(json_module.dumps(dataclasses.asdict(made), default=str))
        return 0
    for note in made.notes:
        print_line(f"note: {note}")
    counts = f"{made.trials} scenes, {made.stimuli} labels, {made.answered} stimuli with answers"
    print_line(f"{counts}: {made.folder}")
    return 0
