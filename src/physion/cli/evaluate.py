"""Train the dynamics and readouts of a model on a dataset and write its predictions."""

from __future__ import annotations

import json as json_module
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from physion.cli.model_options import parse_options
from physion.cli.output import Stages, console
from physion.compute.local import LocalExecutor
from physion.readout.evaluate import evaluate
from physion.readout.settings import EvaluationConfig
from physion.trials.dataset import Dataset


@dataclass(frozen=True)
class Options:
    """Options of ``physion evaluate``."""

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset."""
    model: Annotated[str, tyro.conf.Positional]
    """Name of a model; physion ls models lists them."""
    out: Path = Path("runs/models")
    """Folder for predictions and caches."""
    weights: str = ""
    """Weights of the model, the same as --option weights=...: a file, random, or other names."""
    option: tuple[str, ...] = ()
    """Fields of the model's config as NAME=VALUE, such as encoder=resnet50 weights=imagenet."""
    config: Annotated[EvaluationConfig, tyro.conf.arg(name="")] = field(
        default_factory=EvaluationConfig
    )
    """Readouts, training protocol, optimiser and cross-validation."""
    rollout_error: bool = False
    """Also write how far imagined motion is from the true one over time, for particle models."""
    workers: int = os.cpu_count() or 1
    """Number of processes for simulations."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Write the table of predictions; return 1 if some trials have none."""
    with Stages() as stages:
        result = evaluate(
            Dataset(options.dataset),
            options.model,
            options.out,
            options=parse_options(options.option, options.weights),
            config=options.config,
            rollout_errors=options.rollout_error,
            executor=LocalExecutor(workers=options.workers),
            progress=stages,
        )
    if options.json:
        values = {"predictions": str(result.path), "problems": dict(result.problems)}
        if result.rollout_errors is not None:
            values["rollout_errors"] = str(result.rollout_errors)
        print(json_module.dumps(values))
        return 1 if result.problems else 0
    for trial, reason in result.problems.items():
        console.print(f"no prediction: {trial}: {reason}", markup=False, soft_wrap=True)
    count = len(result.predictions)
    console.print(f"{count} predictions: {result.path}", markup=False, soft_wrap=True)
    if result.rollout_errors is not None:
        line = f"errors of imagined motion: {result.rollout_errors}"
        console.print(line, markup=False, soft_wrap=True)
    return 1 if result.problems else 0
