"""Check all files, labels and motions of a dataset, and name the files and fields with faults.

With another dataset also name the trials that differ between both.
"""

from __future__ import annotations

import json as json_module
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physion.cli.output import Stages, counted, print_line
from physion.trials.making.verify import SAMPLE, compare_datasets, verify_dataset


@dataclass(frozen=True)
class Options:
    """Options of ``physion verify``."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset."""
    again: int = SAMPLE
    """Number of trials to simulate and render again for a bitwise comparison; -1: all."""
    repair: bool = False
    """Delete the trial files of damaged trials: the command that made the dataset then makes these
    trials again."""
    against: Path | None = None
    """Folder of another dataset, for example of another machine or version: trials that only one of
    both has, or that differ in scene, motion, label, movies or map, are named."""
    json: bool = False
    """Print one JSON object: faults, differences from trials of another version, and notes; with
    --against also what differs from the other dataset."""


def main(options: Options) -> int:
    """Print faults, notes and differences; return 1 if there is a fault or a difference."""
    against = options.against
    with Stages() as stages:
        result = verify_dataset(
            options.folder, again=options.again, repair=options.repair, progress=stages
        )
    other = [] if against is None else compare_datasets(options.folder, against)
    failed = bool(result.faults or other)
    if options.json:
        compared = {} if against is None else {"against": other}
        print(json_module.dumps({**asdict(result), **compared}, indent=1))
        return 1 if failed else 0
    for line in (*result.notes, *result.other_versions, *result.faults):
        print_line(line)
    others = result.other_versions
    differ = f", {counted(len(others), 'difference')} from another version" if others else ""
    noted = f", {counted(len(result.notes), 'note')}" if result.notes else ""
    line = f"{options.folder}: {counted(len(result.faults), 'fault')}{differ}{noted}"
    if result.damaged:
        trials = counted(len(result.damaged), "damaged trial")
        again = "the command that made the dataset makes them again"
        line += (
            f"; {trials} deleted: {again}"
            if options.repair
            else (f"; --repair deletes the {trials}, and {again}")
        )
    print_line(line)
    if against is not None:
        other.append(f"{options.folder} against {against}: {counted(len(other), 'difference')}")
        for line in other:
            print_line(line)
    return 1 if failed else 0
