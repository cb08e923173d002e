"""Check a dataset: every byte, every label, every motion; say which file and field is wrong."""

from __future__ import annotations

import json as json_module
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physion.cli.output import console, track
from physion.trials.making.verify import SAMPLE, verify_dataset


@dataclass(frozen=True)
class Options:
    """Which dataset, and how thoroughly."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset."""
    again: int = SAMPLE
    """Trials to simulate and render again and compare to the bit; -1 takes all."""
    json: bool = False
    """Print one JSON object: faults, and differences from trials of another version."""


def main(options: Options) -> int:
    """Print faults and notes; return 1 if there is a fault."""
    result = verify_dataset(options.folder, again=options.again, track=track)
    if options.json:
        print(json_module.dumps(asdict(result), indent=1))
        return 1 if result.faults else 0
    for line in (*result.other_versions, *result.faults):
        console.print(line, markup=False, soft_wrap=True)
    others = result.other_versions
    differ = f", {len(others)} differences from another version" if others else ""
    line = f"{options.folder}: {len(result.faults)} faults{differ}"
    console.print(line, markup=False, soft_wrap=True)
    return 1 if result.faults else 0
