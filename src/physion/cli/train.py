"""Train models on a dataset without labels; the same command resumes, and evaluate finds the
results.

Models, training protocols and seeds make a plan of trainings. Those that are done are skipped, and
one that fails does not stop the others.
"""

from __future__ import annotations

import json as json_module
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from physion.cli.output import Stages, console
from physion.cli.plans.choose_models import choose_models
from physion.cli.plans.tables import estimates_table, print_estimates
from physion.compute.run_tasks import ExecutorSettings
from physion.readout.plans.estimates import estimate_plan, time_left
from physion.readout.plans.selection import Selection, count_seeds, parse_protocols
from physion.readout.plans.tasks import TrainingTask
from physion.readout.plans.training_plan import TrainingPlan, TrainingResults
from physion.readout.trainings import SharedTrainConfig
from physion.training.loop import TrainingOverrides
from physion.trials.dataset import Dataset


@dataclass(frozen=True)
class Options:
    """Options of ``physion train``."""

    models: Annotated[str, tyro.conf.Positional]
    """Names of models with commas (physion ls models lists them), or FILE.py:Class."""
    dataset: Annotated[Path, tyro.conf.Positional]
    """Folder of a dataset."""
    protocols: Annotated[str, tyro.conf.arg(aliases=("--protocol",))] = "all"
    """Scenarios that train a model: all, all-but one, or only one; several with commas."""
    scenario: str = ""
    """Scenario that all-but leaves out, or the one of only; default: one training for each."""
    seeds: int = 1
    """Number of trainings of each set, with seeds from --seed on."""
    seed: int = 0
    """First seed: of initial weights, folds and batches."""
    out: Path = Path("runs/models")
    """Folder for trainings and features, that of physion evaluate."""
    size: Literal["small", "paper", "released"] | None = None
    """Configuration of models that have several."""
    option: tuple[str, ...] = ()
    """Fields of the models' configs as NAME=VALUE, such as encoder=resnet50 weights=imagenet; of
    one of several models as MODEL:NAME=VALUE."""
    config: Annotated[SharedTrainConfig, tyro.conf.arg(name="")] = field(
        default_factory=SharedTrainConfig
    )
    """Folds and devices."""
    settings: Annotated[TrainingOverrides, tyro.conf.arg(name="")] = field(
        default_factory=TrainingOverrides
    )
    """Optimiser and schedule."""
    compute: Annotated[ExecutorSettings, tyro.conf.arg(name="")] = field(
        default_factory=ExecutorSettings
    )
    """Where tasks run, and their limits. On Slurm and Ray a training of the plan is a task; on this
    machine one runs after the other."""
    verify: bool = True
    """Compare files with their SHA-256 in the index before they are used."""
    dry_run: bool = False
    """Print the plan with the estimated time of each training, and train nothing. Models of which
    no training is finished make a few steps to be measured."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Train what is missing of a plan; return 1 if a training of several failed."""
    selection = Selection(
        tuple(choose_models(options.models, options.option, size=options.size)),
        parse_protocols(options.protocols),
        count_seeds(options.seed, options.seeds),
        options.scenario,
    )
    dataset = Dataset(options.dataset, verify=options.verify)
    plan = TrainingPlan(dataset, options.out, selection, options.settings, options.config)
    if options.dry_run:
        with Stages() as stages:
            estimates = estimate_plan(plan, stages)
        print_estimates(estimates_table(estimates), "trainings", options.json)
        return 0
    with Stages() as stages:

        def show(task: TrainingTask, reason: str, left: Sequence[TrainingTask]) -> None:
            if len(plan.tasks) > 1:
                outcome = f"failed: {reason}" if reason else "trained"
                stages.note(f"{task.label}: {outcome}{time_left(plan, left)}")

        cells = None if options.compute.executor == "local" else options.compute.open()
        results = plan.run(stages, show, cells=cells)
    if plan.is_first_process:
        _print(plan, results, options.json)
    return 1 if results.failed else 0


def _print(plan: TrainingPlan, results: TrainingResults, json: bool) -> None:
    if json:
        print(json_module.dumps(_values(results)))
        return
    several = len(plan.tasks) > 1
    for task, trained in results.trained:
        for note in trained["notes"]:
            _line(note)
        if not (several and trained["loaded"]):
            _line(f"{task.label if several else task.planned.name} {_summary(trained)}")
    before = sum(trained["loaded"] for _, trained in results.trained)
    if several and before:
        _line(f"{before} of {len(plan.tasks)} trainings were done before")
    for task, reason in results.failed:
        _line(f"failed: {task.label}: {reason}")


def _summary(trained: dict[str, Any]) -> str:
    """Return what happened, the losses, and the folder of a training."""
    losses = []
    for name, what in (
        ("loss", "loss"),
        ("validation", "held-out trials"),
        ("baseline", "trivial predictor"),
    ):
        value = trained[name]
        if value is not None and not math.isnan(value):
            losses.append(f"{what} {value:.4g}")
    done = "was trained before" if trained["loaded"] else f"trained for {trained['steps']} steps"
    return f"{done}, {', '.join(losses)}: {trained['folder']}"


def _values(results: TrainingResults) -> dict[str, Any]:
    return {
        "trained": [{**_identity(task), **trained} for task, trained in results.trained],
        "failed": [{**_identity(task), "reason": reason} for task, reason in results.failed],
    }


def _identity(task: TrainingTask) -> dict[str, Any]:
    return {"model": task.choice.name, "protocol": task.protocol.value, "seed": task.seed}


def _line(text: str) -> None:
    console.print(text, markup=False, soft_wrap=True)
