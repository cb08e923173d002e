"""Run the whole pipeline: scenes, physics, rendering, trials, models, readouts, report.

Without options, a balanced sample of the official scenes that ship with the package is simulated
and rendered, models predict them, and all are compared with the people of the original study. A
second run resumes, and a larger --limit only adds.
"""

from __future__ import annotations

import json as json_module
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from physion.cli.output import Stages, console
from physion.cli.run.plan import plan_official, plan_sampled
from physion.cli.run.predict import check_models, predict
from physion.cli.run.report import write_report
from physion.data.official import PACKAGED
from physion.errors import BadInputError

if TYPE_CHECKING:
    from physion.trials.making.plan import TrialTask


@dataclass(frozen=True)
class Options:
    """Options of ``physion run``."""

    scenes: Path = Path(PACKAGED)
    """Official scenes: those of the package (official), a folder made by import-official, or one
    with command logs."""
    humans: Path | None = None
    """Answers of people to these scenes: official, or a folder with human_accuracy-*.csv. Default:
    official with the scenes of the package, else none."""
    sampled: bool = False
    """Sample scenes of Dominoes, Collide and Drop instead; nobody has seen them."""
    models: tuple[str, ...] = ()
    """Models, separated by spaces or commas (physion ls models)."""
    out: Path | None = None
    """Folder for trials, predictions and the report; default: runs/official or runs/sampled."""
    limit: int | None = None
    """Testing trials per scenario, 12 by default, and as many for the readout (twice as many of
    sampled ones); 0 takes all official ones."""
    size: int = 128
    """Pixels per side of the movies."""
    encoder: str = "resnet18"
    """Image encoder of frozen-encoder, any timm name."""
    weights: str = "random"
    """Weights of this encoder: imagenet (downloaded by timm), package:NAME, a file, or random."""
    dynamics: str = "mlp"
    """Dynamics of frozen-encoder that predict the next feature: mlp or lstm."""
    steps: int = 300
    """Training steps of models that learn."""
    encoder_batch: int = 4
    """Clips that a network encodes at a time; lower it when memory runs out."""
    samples: int = 20
    """Simulations per trial of noisy-simulation."""
    engine: str = "physion"
    """Engine of the trials and of noisy-simulation (physion ls engines); mujoco has no cloth."""
    workers: int = os.cpu_count() or 1
    """Number of processes."""
    json: bool = False
    """Print one JSON object instead of lines."""


def main(options: Options) -> int:
    """Run the whole pipeline; return 1 if some trials failed."""
    options = _complete(options)
    assert options.out is not None
    check_models(options)
    plan = (
        plan_sampled(options.limit)
        if options.sampled
        else plan_official(options.scenes, options.humans, options.limit)
    )
    failures = [*plan.failures, *write_trials(options, options.out, plan.tasks)]
    predictions, problems = predict(options, options.out)
    page, scores = write_report(options, options.out, plan, predictions)
    failures += problems
    if options.json:
        values = {"report": str(page), "scores": scores, "failures": failures}
        print(json_module.dumps(values, indent=1))
    else:
        for failure in failures:
            console.print(f"failed: {failure}", markup=False, soft_wrap=True)
        console.print(f"report of {len(predictions)} models: {page}", markup=False, soft_wrap=True)
    return 1 if failures else 0


def _complete(options: Options) -> Options:
    """Return the options with what follows from others; raise `BadInputError` if they disagree."""
    from physion.cli.official.read import humans_folder, official_data

    if options.sampled and options.humans is not None:
        raise BadInputError("--sampled scenes were seen by nobody: leave out --humans")
    if options.limit is not None and options.limit < (1 if options.sampled else 0):
        raise BadInputError(f"--limit must be at least 1, not {options.limit}")
    out = options.out or Path("runs") / ("sampled" if options.sampled else "official")
    humans = options.humans
    if not options.sampled and humans is None and official_data(options.scenes) is not None:
        humans = options.scenes
    humans = None if humans is None else humans_folder(humans)
    return replace(options, out=out, humans=humans)


def write_trials(options: Options, folder: Path, tasks: list[TrialTask]) -> list[str]:
    """Simulate, label, render and store missing trials; return the failures."""
    from physion.compute.local import LocalExecutor
    from physion.trials.making.generate import make_trials
    from physion.trials.making.plan import GenerateSettings

    with Stages() as stages:
        report = make_trials(
            folder / "trials",
            tasks,
            GenerateSettings(
                width=options.size,
                height=options.size,
                look="redyellow",
                jitters=0,
                engine=options.engine,
            ),
            executor=LocalExecutor(workers=options.workers),
            progress=stages,
        )
    return [f"{name}: {reason}" for name, reason in report.failed.items()]
