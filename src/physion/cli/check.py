"""Test whether predictions of a model depend on what they must not depend on.

The model predicts some trials, and copies of them in which one thing is changed: what follows the
observed part becomes noise, outcomes are inverted, names and order change. Such changes must not
move a prediction. For other changes it is shown how much they move predictions. Exit code 1: a
prediction moved that must not, or nothing was judged.
"""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from physion.analysis.tables import records
from physion.checking import CheckResult, check, described
from physion.cli.arguments import take_options
from physion.cli.output import Stages, print_line, print_warnings, text_table
from physion.compute.local import LocalExecutor
from physion.compute.run_tasks import ExecutorSettings
from physion.core.settings import split_names
from physion.readout.settings import EvaluationSettings, options_by_model
from physion.trials.dataset import Dataset


@dataclass(frozen=True)
class Options:
    """Options of ``physion check``."""

    model: Annotated[str, tyro.conf.Positional]
    """Name of a model (physion ls models lists them), or FILE.py:Class."""
    dataset: Annotated[Path | None, tyro.conf.Positional] = None
    """Folder of a dataset; default: trials of Collide and Drop, made in the output folder."""
    out: Path = Path("runs/check")
    """Folder for the page, and for the trials if none are given."""
    trials: int = 80
    """About how many trials are taken: half of them fit the readout, half are tested. Each half
    is rounded down for each scenario, to at least 2."""
    changes: tuple[str, ...] = ()
    """Names of the changes to make; default: all, and evaluations of two other models."""
    option: tuple[str, ...] = ()
    """Settings of the model as NAME=VALUE, such as weights=random. Of the check: encoder_batch=1,
    clips that a network encodes at a time (default: 4); lower it when memory runs out."""
    readouts: tuple[str, ...] = EvaluationSettings.readouts
    """Readouts: observed, observed+simulated, full. Default: all but full, which is checked if the
    model has no other."""
    decision: str = EvaluationSettings.decision
    """What turns features or rollouts into P(contact); default: the model's own."""
    rendered: bool = EvaluationSettings.rendered
    """Render the pictures from the stored motions instead of reading the movies."""
    accelerator: str = EvaluationSettings.accelerator
    """Device of the networks, by Lightning's name: auto, cpu, cuda, ... Use cpu for an exact check:
    sums on a GPU may differ from call to call."""
    workers: int = ExecutorSettings.workers
    """Number of processes."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Print the table of changes and write the page; return 1 unless the model passed."""
    asked = EvaluationSettings(
        readouts=options.readouts,
        decision=options.decision,
        rendered=options.rendered,
        accelerator=options.accelerator,
    )
    settings, of_model = take_options(asked, options.option)
    with Stages() as stages:
        done = check(
            options.model,
            None if options.dataset is None else Dataset(options.dataset),
            options.out,
            settings,
            options=options_by_model([options.model], of_model)[options.model],
            trials=options.trials,
            changes=split_names(options.changes, "change") if options.changes else (),
            executor=LocalExecutor(options.workers),
            progress=stages,
        )
    page = done.report(options.out)
    print_warnings(done.warnings)
    _print(done, page, options)
    return 0 if done.passed else 1


def _print(done: CheckResult, page: Path, options: Options) -> None:
    if options.json:
        rows = records(done.table)
        values = {"model": done.model, "passed": done.passed, "refused": done.refused}
        values["verdict"] = done.verdict
        print(json_module.dumps(values | {"changes": rows, "page": str(page)}))
        return
    print_line(text_table(described(done.table)))
    for row in done.table[done.table["note"] != ""].itertuples():
        print_line(f"{row.change}, {row.readout}: {row.note}")
    print_line(done.verdict)
    print_line(f"page: {page}")
