"""Train the dynamics and readouts of models on a dataset and write their predictions.

Models, training protocols and seeds make a plan of evaluations. Those that are done are skipped,
and one that fails does not stop the others. The results are one table, with mean and spread over
seeds.
"""

from __future__ import annotations

import json as json_module
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro

from physion.cli.output import Stages, console, text_table, write_text
from physion.cli.plans.choose_models import choose_models
from physion.cli.plans.tables import evaluations_table, print_estimates
from physion.compute.run_tasks import ExecutorSettings
from physion.readout.plans.evaluation_plan import EvaluationPlan, EvaluationResults
from physion.readout.plans.keys import key_of
from physion.readout.plans.results import StoredEvaluation, summarise_accuracy
from physion.readout.plans.selection import Selection, count_seeds, parse_protocols
from physion.readout.plans.tasks import EvaluationTask
from physion.readout.settings import EvaluationSettings
from physion.trials.dataset import Dataset


@dataclass(frozen=True)
class Options:
    """Options of ``physion evaluate``."""

    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset."""
    models: Annotated[str, tyro.conf.Positional]
    """Names of models with commas (physion ls models lists them), or FILE.py:Class."""
    protocols: Annotated[str, tyro.conf.arg(aliases=("--training",))] = "all"
    """Scenarios that train a model: all, all-but one, or only the tested one; several with
    commas."""
    scenario: str = ""
    """Tested scenario, under all-but and only; default: all of them."""
    seeds: int = 1
    """Number of evaluations, with seeds from --seed on."""
    seed: int = 0
    """First seed: of initial weights, folds and training."""
    out: Path = Path("runs/models")
    """Folder for predictions and caches."""
    weights: str = ""
    """Weights of the models, the same as --option weights=...: a file, random, or other names."""
    option: tuple[str, ...] = ()
    """Fields of the models' configs as NAME=VALUE, such as encoder=resnet50 weights=imagenet; of
    one of several models as MODEL:NAME=VALUE."""
    config: Annotated[EvaluationSettings, tyro.conf.arg(name="")] = field(
        default_factory=EvaluationSettings
    )
    """Readouts, optimiser and cross-validation."""
    rollout_error: bool = False
    """Also write how far imagined motion is from the true one over time, for particle models."""
    compute: Annotated[ExecutorSettings, tyro.conf.arg(name="")] = field(
        default_factory=ExecutorSettings
    )
    """Where tasks run, and their limits: on Slurm and Ray one evaluation of the plan is a task, on
    this machine a simulation."""
    verify: bool = True
    """Compare files with their SHA-256 in the index before they are used."""
    dry_run: bool = False
    """Print the plan, with the mean time of earlier evaluations of each model, and do nothing."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Write the tables of predictions; return 1 if some trials, or evaluations, have none."""
    selection = Selection(
        tuple(choose_models(options.models, options.option, weights=options.weights)),
        parse_protocols(options.protocols),
        count_seeds(options.seed, options.seeds),
        options.scenario,
    )
    plan = EvaluationPlan(
        Dataset(options.dataset, verify=options.verify),
        options.out,
        selection,
        options.config,
        rollout_errors=options.rollout_error,
    )
    if options.dry_run:
        print_estimates(evaluations_table(plan), "evaluations", options.json)
        return 0
    with Stages() as stages:

        def show(task: EvaluationTask, reason: str, left: Sequence[EvaluationTask]) -> None:
            if len(plan.tasks) > 1:
                outcome = f"failed: {reason}" if reason else "evaluated"
                stages.note(f"{task.label}: {outcome}; {len(left)} left")

        executor = options.compute.open()
        cells = None if options.compute.executor == "local" else executor
        results = plan.run(None if cells else executor, stages, show, cells=cells)
    _print(plan, results, options)
    return 1 if results.failed or results.problems else 0


def _print(plan: EvaluationPlan, results: EvaluationResults, options: Options) -> None:
    several = len(plan.tasks) > 1
    summary = summarise_accuracy(results.evaluated)
    path = options.out / "results" / f"{key_of([task.key for task in plan.tasks])[:12]}.csv"
    if several and len(summary):
        write_text(path, summary.round(6).to_csv(index=False, lineterminator="\n"))
    if options.json:
        values: dict[str, Any] = {
            "evaluations": [_values(task, evaluation) for task, evaluation in results.tables],
            "failed": [{**_identity(task), "reason": why} for task, why in results.failed],
        }
        if several:
            values["results"] = str(path)
        print(json_module.dumps(values))
        return
    for where, reason in results.problems.items():
        _line(f"no prediction: {where if several else where.partition(': ')[2]}: {reason}")
    for _, evaluation in results.tables:
        _line(f"{evaluation.count} predictions: {evaluation.path}")
        if evaluation.rollout_errors is not None:
            _line(f"errors of imagined motion: {evaluation.rollout_errors}")
    if several:
        if len(summary):
            _line(text_table(summary))
            _line(f"results: {path}")
        if len(plan.done):
            _line(f"{len(plan.done)} of {len(plan.tasks)} evaluations were done before")
    for task, reason in results.failed:
        _line(f"failed: {task.label}: {reason}")


def _values(task: EvaluationTask, evaluation: StoredEvaluation) -> dict[str, Any]:
    values = {
        **_identity(task),
        "predictions": str(evaluation.path),
        "problems": dict(evaluation.problems),
    }
    if evaluation.rollout_errors is not None:
        values["rollout_errors"] = str(evaluation.rollout_errors)
    return values


def _identity(task: EvaluationTask) -> dict[str, Any]:
    protocol = task.protocol.value if task.set_name else None
    return {"model": task.choice.name, "protocol": protocol, "seed": task.seed}


def _line(text: str) -> None:
    console.print(text, markup=False, soft_wrap=True)
