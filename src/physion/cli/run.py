"""Run the whole pipeline: scenes, physics, rendering, trials, models, readouts, report.

Without --scenes, scenes of Dominoes, Collide and Drop are sampled. With --scenes, official command
logs are simulated instead, and with --humans the models are compared with people's responses.
"""

from __future__ import annotations

import json as json_module
import os
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from physion.cli.output import Stages, console
from physion.errors import BadInputError

if TYPE_CHECKING:
    from physion.scenes.tdw.read_logs import ImportedTrial
    from physion.trials.making.plan import TrialTask

SAMPLED_SCENARIOS = ("dominoes", "collide", "drop")


@dataclass(frozen=True)
class Options:
    """Options of ``physion run``."""

    scenes: Path | None = None
    """Folder with official command logs; by default scenes are sampled."""
    humans: Path | None = None
    """Folder with human_accuracy-*.csv, people's responses to these scenes."""
    out: Path | None = None
    """Folder for trials, predictions and the report; default: runs/sampled or runs/official.
    A second run resumes."""
    limit: int | None = None
    """Testing trials per scenario. Official scenes: all by default, and as many for the readout;
    sampled ones: 12 by default, and twice as many for the readout."""
    size: int = 128
    """Pixels per side of the movies."""
    encoder: str = "resnet18"
    """Frozen image encoder, any timm name."""
    weights: str = "random"
    """Weights of the encoder: imagenet (downloaded by timm), a file, or random."""
    dynamics: str = "mlp"
    """Dynamics that predict the next feature: mlp or lstm."""
    steps: int = 300
    """Training steps of the dynamics."""
    samples: int = 20
    """Simulations per trial of noisy-simulation."""
    engine: str = "physion"
    """Engine of the trials and of noisy-simulation (see physion ls engines); mujoco has no
    cloth."""
    workers: int = os.cpu_count() or 1
    """Number of processes."""
    json: bool = False
    """Print one JSON object instead of lines."""


@dataclass(frozen=True)
class RunPlan:
    """Trials to generate, recorded outcomes by stimulus, and failures of the import."""

    tasks: list[TrialTask]
    recorded: Mapping[str, bool]
    failures: list[str]


def main(options: Options) -> int:
    """Run the whole pipeline; return 1 if some trials failed."""
    if options.out is None:
        name = "sampled" if options.scenes is None else "official"
        options = replace(options, out=Path("runs") / name)
    if options.humans is not None and options.scenes is None:
        raise BadInputError("--humans requires --scenes: people saw only the official scenes")
    if options.limit is not None and options.limit < 1:
        raise BadInputError(f"--limit must be at least 1, not {options.limit}")
    check_models(options)
    plan = plan_sampled(options) if options.scenes is None else plan_official(options)
    failures = [*plan.failures, *generate_trials(options, plan.tasks)]
    predictions, problems = predict(options)
    page, scores = write_report(options, plan, predictions)
    failures += problems
    if options.json:
        values = {"report": str(page), "scores": scores, "failures": failures}
        print(json_module.dumps(values, indent=1))
    else:
        for failure in failures:
            console.print(f"failed: {failure}", markup=False, soft_wrap=True)
        console.print(f"report of {len(predictions)} models: {page}", markup=False, soft_wrap=True)
    return 1 if failures else 0


def out_folder(options: Options) -> Path:
    """Return the output folder."""
    assert options.out is not None, "main sets the folder"
    return options.out


def plan_sampled(options: Options) -> RunPlan:
    """Plan a small set of sampled trials: testing, and twice as many for the readout."""
    from physion.trials.making.plan import plan_dataset

    count = 12 if options.limit is None else options.limit
    tasks = plan_dataset("sampled", SAMPLED_SCENARIOS, {"readout": 2 * count, "testing": count})
    return RunPlan(tasks, {}, [])


def plan_official(options: Options) -> RunPlan:
    """Plan the official scenes: those that people saw are tested, the others fit the readout."""
    from physion.analysis.tables.responses import read_humans
    from physion.scenes.tdw.read_logs import read_scenes
    from physion.stimulus_names import canonical_name
    from physion.trials.making.plan import check_names, plan_scenes

    assert options.scenes is not None
    seen = set(read_humans(options.humans)["stimulus"]) if options.humans is not None else None
    logs = read_scenes(options.scenes)
    logs.require_trials()
    recorded = {trial.scene.name: trial.outcome.contact for trial in logs.trials}
    parts: dict[str, list[ImportedTrial]] = {"testing": [], "readout": []}
    for trial in logs.trials:
        # Familiarization trials are neither tested nor fitted.
        if "familiarization" not in trial.scene.name:
            tested = seen is None or canonical_name(trial.scene.name) in seen
            parts["testing" if tested else "readout"].append(trial)
    # Scenes with the physics of a tested one are not fitted.
    known = {trial.scene.physics_digest() for trial in parts["testing"]}
    parts["readout"] = [t for t in parts["readout"] if t.scene.physics_digest() not in known]
    tasks: list[TrialTask] = []
    for split, trials in parts.items():
        scenes = [trial.scene for trial in limit_trials(trials, options.limit)]
        tasks += plan_scenes("official", scenes, split, recorded)
    if not any(task.split == "testing" for task in tasks):
        raise BadInputError(f"none of the scenes in {options.scenes} is in {options.humans}")
    check_names(tasks)
    return RunPlan(tasks, recorded, [str(failure) for failure in logs.failures])


def limit_trials(trials: Iterable[ImportedTrial], limit: int | None) -> list[ImportedTrial]:
    """Return at most ``limit`` trials per scenario, spread over its configurations.

    The choice depends on the names alone; a larger limit includes the trials of a smaller one.
    """
    from physion.seeds import stable_hash

    groups: dict[str, list[ImportedTrial]] = defaultdict(list)
    for trial in sorted(trials, key=lambda trial: stable_hash("limit", trial.scene.name)):
        groups[trial.scene.scenario].append(trial)
    return [trial for group in groups.values() for trial in group[:limit]]


def generate_trials(options: Options, tasks: list[TrialTask]) -> list[str]:
    """Simulate, label, render and store missing trials; return the failures."""
    from physion.compute.local import LocalExecutor
    from physion.trials.making.generate import make_trials
    from physion.trials.making.plan import GenerateSettings

    with Stages() as stages:
        report = make_trials(
            out_folder(options) / "trials",
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


def chosen_models(options: Options) -> dict[str, dict[str, Any]]:
    """Return the models of this run and the options of each."""
    return {
        "frozen-encoder": {
            "encoder": options.encoder,
            "weights": options.weights,
            "dynamics": options.dynamics,
        },
        "noisy-simulation": {"samples": options.samples, "engine": options.engine},
    }


def check_models(options: Options) -> None:
    """Build every model once, so that a wrong name or a missing extra fails early."""
    from physion.models import build_model

    for model, settings in chosen_models(options).items():
        build_model(model, **settings)


def predict(options: Options) -> tuple[list[Path], list[str]]:
    """Write predictions of a frozen encoder and of noisy simulation; return paths and failures."""
    from physion.compute.local import LocalExecutor
    from physion.readout import EvaluationConfig, evaluate
    from physion.trials.dataset import Dataset

    dataset = Dataset(out_folder(options) / "trials")
    paths: list[Path] = []
    problems: list[str] = []
    for model, settings in chosen_models(options).items():
        with Stages() as stages:
            evaluation = evaluate(
                dataset,
                model,
                out_folder(options) / "models",
                options=settings,
                config=EvaluationConfig(steps=options.steps),
                executor=LocalExecutor(workers=options.workers),
                progress=stages,
            )
        paths.append(evaluation.path)
        problems += [f"{model}: {name}: {why}" for name, why in evaluation.problems.items()]
    return paths, problems


def write_report(
    options: Options, plan: RunPlan, predictions: list[Path]
) -> tuple[Path, list[dict[str, Any]]]:
    """Write the report; return its page and the table of scores."""
    import pandas as pd

    from physion.report.build import compare_files
    from physion.report.page.movies import movies_of
    from physion.stimulus_names import canonical_name
    from physion.trials.dataset import Dataset

    dataset = Dataset(out_folder(options) / "trials")
    page = compare_files(
        predictions,
        options.humans,
        {canonical_name(name): contact for name, contact in plan.recorded.items()} or None,
        out_folder(options) / "report",
        methods=methods(options, dataset.index),
        movies=movies_of(dataset.folder),
    )
    scores = pd.read_csv(page.parent / "tables" / "comparison.csv")
    return page, json_module.loads(scores.to_json(orient="records"))


def methods(options: Options, index: Any) -> dict[str, str]:
    """Return the settings of this run as texts for the report."""
    splits = index.groupby("split").size()
    counts = ", ".join(f"{count} {split}" for split, count in splits.items())
    source = "sampled by this package" if options.scenes is None else "official command logs"
    return {
        "Scenes": f"{source}; trials: {counts}; movies of {options.size} x {options.size} pixels",
        "Readout": "one L2 logistic regression per scenario on standardised features, C from 17 "
        "values in 1e-8 to 1e8 by stratified 5-fold cross-validation on readout trials",
        "Encoder weights": f"{options.encoder}: {options.weights}, frozen; {options.dynamics} "
        f"dynamics of 1024 hidden units, {options.steps} steps of Adam",
        "Noise of the simulation": f"{options.samples} simulations per trial from the true state "
        "at the end of the observed part; the noise scale is fitted on readout trials alone",
        "Engine": ", ".join(sorted(set(index["engine"]))),
        "Renderer": ", ".join(sorted(set(index["renderer"]))),
    }
