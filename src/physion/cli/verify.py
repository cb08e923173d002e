"""Check all files, labels and motions of a dataset, and name the files and fields with faults."""

from __future__ import annotations

import json as json_module
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physion.cli.output import Stages, console
from physion.trials.making.verify import SAMPLE, verify_dataset


@dataclass(frozen=True)
class Options:
    """Options of ``physion verify``."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset."""
    again: int = SAMPLE
    """Number of trials to simulate and render again for a bitwise comparison; -1: all."""
    json: bool = False
    """Print one JSON object: faults, differences from trials of another version, and notes."""


def main(options: Options) -> int:
    """Print faults and notes; return 1 if there is a fault."""
    with Stages() as stages:
        result = verify_dataset(options.folder, again=options.again, progress=stages)
    if options.json:
        print(json_module.dumps(asdict(result), indent=1))
        return 1 if result.faults else 0
    for line in (*result.notes, *result.other_versions, *result.faults):
        console.print(line, markup=False, soft_wrap=True)
    others = result.other_versions
    differ = f", {len(others)} differences from another version" if others else ""
    noted = f", {len(result.notes)} notes" if result.notes else ""
    line = f"{options.folder}: {len(result.faults)} faults{differ}{noted}"
    console.print(line, markup=False, soft_wrap=True)
    return 1 if result.faults else 0
