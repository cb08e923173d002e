"""Train models on a dataset; the same command resumes, and evaluate finds the results.

Models whose weights ship are trained from random weights. One training that fails does not stop the
others.
"""

from __future__ import annotations

import dataclasses
import json as json_module
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import pandas as pd
import tyro

from physion.cli.arguments import take_options
from physion.cli.output import Stages, print_line, print_plan, text_table
from physion.compute.run_tasks import ExecutorSettings
from physion.core.settings import split_names
from physion.readout.settings import TrainSettings, options_by_model
from physion.readout.train import Trainings, train
from physion.trials.dataset import Dataset


@dataclass(frozen=True)
class Options:
    """Options of ``physion train``."""

    models: Annotated[str, tyro.conf.Positional]
    """Names of models with commas (physion ls models lists them), or FILE.py:Class."""
    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset."""
    out: Path = Path("runs/models")
    """Folder for trainings and features, as for physion evaluate."""
    option: tuple[str, ...] = ()
    """Settings of the models or of their training as NAME=VALUE, such as size=paper steps=500
    batch=16 learning_rate=1e-3; of one of several models as MODEL:NAME=VALUE. Of all trainings:
    folds=3, parts into which trials are divided where a dataset without a readout split is
    cross-validated (default: 5); encoder_batch=1, clips that a network encodes at a time (default:
    4; lower it when memory runs out)."""
    settings: Annotated[TrainSettings, tyro.conf.arg(name="")] = field(
        default_factory=TrainSettings
    )
    """Protocols, seeds, folds, batches and devices."""
    compute: Annotated[ExecutorSettings, tyro.conf.arg(name="")] = field(
        default_factory=ExecutorSettings
    )
    """Where trainings run: on Slurm and Ray, one model, protocol and seed is a task; on this
    machine one runs after the other."""
    dry_run: bool = False
    """Train nothing; print what would be trained, and what is done."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Train what is missing; return 1 if a training of several failed."""
    settings, of_models = take_options(options.settings, options.option)
    with Stages() as stages:
        done = train(
            options_by_model(split_names(options.models, "model"), of_models),
            Dataset(options.dataset),
            options.out,
            settings,
            executor=options.compute.open(),
            progress=stages,
            dry_run=options.dry_run,
        )
    from physion.training.devices import is_first_process

    if is_first_process():
        _print(done, options)
    return 1 if done.failed else 0


def _print(done: Trainings, options: Options) -> None:
    if options.json:
        print(json_module.dumps(_values(done)))
        return
    if options.dry_run:
        print_plan(done.planned, ["model", "name", "seed", "folder", "done"], "trainings")
        return
    for note in (note for trained in done.trained for note in trained.notes):
        print_line(note)
    if done.trained:
        print_line(text_table(_described(done)))
    for label, reason in done.failed.items():
        print_line(f"failed: {label}: {reason}")


def _described(done: Trainings) -> pd.DataFrame:
    """Return the trainings as a table for the terminal, with the losses where they are known."""
    rows = [
        {
            "model": one.model,
            "training": one.name,
            "seed": one.seed,
            "how": "was trained before" if one.loaded else f"trained for {one.steps} steps",
            "loss": one.loss,
            "held-out trials": one.validation,
            "trivial predictor": one.baseline,
            "folder": str(one.folder),
        }
        for one in done.trained
    ]
    table = pd.DataFrame(rows)
    for name in ("loss", "held-out trials", "trivial predictor"):
        table[name] = ["-" if math.isnan(value) else f"{value:.4g}" for value in table[name]]
    return table


def _values(done: Trainings) -> dict[str, Any]:
    def plain(value: Any) -> Any:
        if isinstance(value, float) and math.isnan(value):
            return None
        return str(value) if isinstance(value, Path) else value

    def fields(one: Any) -> dict[str, Any]:
        return {name: plain(value) for name, value in dataclasses.asdict(one).items()}

    return {
        "trained": [fields(one) for one in done.trained],
        "planned": [fields(one) for one in done.planned],
        "failed": [{"cell": label, "reason": reason} for label, reason in done.failed.items()],
    }
