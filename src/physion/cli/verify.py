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
from physion.trials.making.verify import SAMPLE, DatasetComparison, compare_datasets, verify_dataset


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
    both has, or that differ in scene, motion, label or bytes of files, are named."""
    json: bool = False
    """Print one JSON object: faults, differences from trials of another version, and notes; with
    --against also what differs from the other dataset."""


def main(options: Options) -> int:
    """Print faults, notes and differences; return 1 if there is a fault or a difference."""
    other = None
    with Stages() as stages:
        result = verify_dataset(
            options.folder, again=options.again, repair=options.repair, progress=stages
        )
        if options.against is not None:
            other = compare_datasets(options.folder, options.against, progress=stages)
    failed = bool(result.faults) or (other is not None and not other.equal)
    if options.json:
        compared = {} if other is None else {"against": asdict(other)}
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
    if other is not None and options.against is not None:
        _print_comparison(other, options.folder, options.against)
    return 1 if failed else 0


def _print_comparison(compared: DatasetComparison, folder: Path, against: Path) -> None:
    """Print what differs between two datasets, and a line that counts it."""
    lines = [f"made by other versions: {line}" for line in compared.versions]
    for place, names in ((folder, compared.only_first), (against, compared.only_second)):
        lines += [f"{name}: only in {place}" for name in names]
    lines += compared.differences
    single = len(compared.only_first) + len(compared.only_second)
    lines.append(
        f"{folder} against {against}: {compared.same} trials are the same, "
        f"{len(compared.differences)} differ, {single} are only in one of them"
    )
    for line in lines:
        print_line(line)
