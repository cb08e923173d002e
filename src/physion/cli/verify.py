"""Check a dataset: every byte, every label, every motion; say which file and field is wrong."""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physion.cli.output import console, track
from physion.trials.verify import SAMPLE, verify_dataset


@dataclass(frozen=True)
class Options:
    """Which dataset, and how thoroughly."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset."""
    again: int = SAMPLE
    """Trials to simulate and render again and compare to the bit; -1 takes all."""
    json: bool = False
    """Print the faults as one JSON list."""


def main(options: Options) -> int:
    """Print the faults; 1 if there is one."""
    faults = verify_dataset(options.folder, again=options.again, track=track)
    if options.json:
        print(json_module.dumps(faults, indent=1))
        return 1 if faults else 0
    for fault in faults:
        console.print(fault, markup=False, soft_wrap=True)
    console.print(f"{options.folder}: {len(faults)} faults", markup=False, soft_wrap=True)
    return 1 if faults else 0
