"""The whole road: scenes, physics, pictures, trials, models, readout, comparison, one report.

Without --scenes, scenes of Dominoes, Collide and Drop are sampled. With --scenes the official
command logs are simulated, and with --humans the models are compared with the people who saw them.
"""

from __future__ import annotations

import json as json_module
import os
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from physion.cli.output import Stages, console, track
from physion.errors import BadInputError

if TYPE_CHECKING:
    from physion.scenes.tdw.read_logs import ImportedTrial
    from physion.trials.making.plan import TrialTask

SAMPLED_SCENARIOS = ("dominoes", "collide", "drop")


@dataclass(frozen=True)
class Options:
    """Where scenes and people come from, and how much of everything."""

    scenes: Path | None = None
    """Folder with official command logs; without it scenes are sampled."""
    humans: Path | None = None
    """Folder with human_accuracy-*.csv: people's answers to those scenes."""
    out: Path | None = None
    """Folder for trials, predictions and the report; runs/sampled or runs/official by default.
    A second run goes on from what is there."""
    limit: int | None = None
    """Testing trials a scenario. Official scenes: all by default, and as many for the readout;
    sampled ones: 12 by default, and twice as many for the readout."""
    size: int = 128
    """Pixels a side of the movies."""
    encoder: str = "resnet18"
    """Frozen image encoder, any timm name."""
    weights: str = "random"
    """Its weights: imagenet (downloaded by timm), a file, or random."""
    dynamics: str = "mlp"
    """What predicts the next feature: mlp or lstm."""
    steps: int = 300
    """Training steps of the dynamics."""
    samples: int = 20
    """Simulations a trial of noisy-simulation."""
    workers: int = os.cpu_count() or 1
    """Processes."""
    json: bool = False
    """Print one JSON object instead of lines."""


@dataclass(frozen=True)
class Plan:
    """What is to be made, the recorded outcomes by stimulus, and what could not be imported."""

    tasks: list[TrialTask]
    recorded: Mapping[str, bool]
    failures: list[str]


def main(options: Options) -> int:
    """Go the road; 1 if some trials failed on the way."""
    if options.out is None:
        name = "sampled" if options.scenes is None else "official"
        options = replace(options, out=Path("runs") / name)
    if options.humans is not None and options.scenes is None:
        raise BadInputError("--humans needs --scenes: people saw the official scenes only")
    if options.limit is not None and options.limit < 1:
        raise BadInputError(f"--limit must be 1 or more, not {options.limit}")
    check_models(options)
    plan = plan_sampled(options) if options.scenes is None else plan_official(options)
    failures = [*plan.failures, *make_trials(options, plan.tasks)]
    predictions, problems = ask_models(options)
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


def folder(options: Options) -> Path:
    """Where everything of this run goes."""
    assert options.out is not None, "main chooses a folder"
    return options.out


def plan_sampled(options: Options) -> Plan:
    """A small set of sampled trials: testing, and as many again for the readout."""
    from physion.trials.making.plan import plan_dataset

    count = 12 if options.limit is None else options.limit
    tasks = plan_dataset("sampled", SAMPLED_SCENARIOS, {"readout": 2 * count, "testing": count})
    return Plan(tasks, {}, [])


def plan_official(options: Options) -> Plan:
    """The official scenes: those that people saw for testing, the others for the readout."""
    from physion.analysis.tables.responses import read_humans
    from physion.scenes.tdw.read_logs import read_scenes
    from physion.stimulus_names import canonical_name
    from physion.trials.making.plan import check_names, plan_scenes

    assert options.scenes is not None
    seen = set(read_humans(options.humans)["stimulus"]) if options.humans is not None else None
    found = read_scenes(options.scenes)
    found.require_trials()
    recorded = {trial.scene.name: trial.outcome.contact for trial in found.trials}
    parts: dict[str, list[ImportedTrial]] = {"testing": [], "readout": []}
    for trial in found.trials:
        # What people practised on is nobody's test and nobody's readout.
        if "familiarization" not in trial.scene.name:
            tested = seen is None or canonical_name(trial.scene.name) in seen
            parts["testing" if tested else "readout"].append(trial)
    # A scene that only looks different is no new scene to fit on.
    known = {trial.scene.physics_digest() for trial in parts["testing"]}
    parts["readout"] = [t for t in parts["readout"] if t.scene.physics_digest() not in known]
    tasks: list[TrialTask] = []
    for split, trials in parts.items():
        scenes = [trial.scene for trial in few(trials, options.limit)]
        tasks += plan_scenes("official", scenes, split, recorded)
    if not any(task.split == "testing" for task in tasks):
        raise BadInputError(f"none of the scenes in {options.scenes} is in {options.humans}")
    check_names(tasks)
    return Plan(tasks, recorded, [str(failure) for failure in found.failures])


def few(trials: Iterable[ImportedTrial], limit: int | None) -> list[ImportedTrial]:
    """At most ``limit`` trials a scenario, spread over its configurations.

    Which ones depends on their names alone, and a larger limit keeps all that a smaller one had.
    """
    from physion.seeds import stable_hash

    groups: dict[str, list[ImportedTrial]] = defaultdict(list)
    for trial in sorted(trials, key=lambda trial: stable_hash("limit", trial.scene.name)):
        groups[trial.scene.scenario].append(trial)
    return [trial for group in groups.values() for trial in group[:limit]]


def make_trials(options: Options, tasks: list[TrialTask]) -> list[str]:
    """Simulate, label, render and store what is missing; why some trials failed."""
    from physion.compute.local import LocalExecutor
    from physion.trials.making.generate import generate
    from physion.trials.making.plan import GenerateSettings

    report = generate(
        folder(options) / "trials",
        tasks,
        GenerateSettings(width=options.size, height=options.size, look="redyellow", jitters=0),
        executor=LocalExecutor(workers=options.workers),
        track=track,
    )
    return [f"{name}: {reason}" for name, reason in report.failed.items()]


def chosen_models(options: Options) -> dict[str, dict[str, Any]]:
    """The models of this run with the fields of their configs."""
    return {
        "frozen-encoder": {
            "encoder": options.encoder,
            "weights": options.weights,
            "dynamics": options.dynamics,
        },
        "noisy-simulation": {"samples": options.samples},
    }


def check_models(options: Options) -> None:
    """Build every model once: a wrong name or a missing extra is said before hours of work."""
    from physion.models.interface import build_model

    for model, settings in chosen_models(options).items():
        build_model(model, **settings)


def ask_models(options: Options) -> tuple[list[Path], list[str]]:
    """Predictions of a frozen encoder and of noisy simulation; why some trials have none."""
    from physion.compute.local import LocalExecutor
    from physion.readout.evaluate import EvaluationConfig, evaluate
    from physion.trials.dataset import Dataset

    dataset = Dataset(folder(options) / "trials")
    paths: list[Path] = []
    problems: list[str] = []
    for model, settings in chosen_models(options).items():
        with Stages() as stages:
            evaluation = evaluate(
                dataset,
                model,
                folder(options) / "models",
                options=settings,
                config=EvaluationConfig(steps=options.steps),
                executor=LocalExecutor(workers=options.workers),
                progress=stages,
            )
        paths.append(evaluation.path)
        problems += [f"{model}: {name}: {why}" for name, why in evaluation.problems.items()]
    return paths, problems


def write_report(
    options: Options, plan: Plan, predictions: list[Path]
) -> tuple[Path, list[dict[str, Any]]]:
    """The report's page and its table of scores."""
    import pandas as pd

    from physion.report.build import compare_files
    from physion.report.page.movies import movies_of
    from physion.stimulus_names import canonical_name
    from physion.trials.dataset import Dataset

    dataset = Dataset(folder(options) / "trials")
    page = compare_files(
        predictions,
        options.humans,
        {canonical_name(name): contact for name, contact in plan.recorded.items()} or None,
        folder(options) / "report",
        methods=methods(options, dataset.index),
        movies=movies_of(dataset.folder),
    )
    scores = pd.read_csv(page.parent / "tables" / "comparison.csv")
    return page, json_module.loads(scores.to_json(orient="records"))


def methods(options: Options, index: Any) -> dict[str, str]:
    """The choices of this run in words, for the report."""
    splits = index.groupby("split").size()
    counts = ", ".join(f"{count} {split}" for split, count in splits.items())
    source = "sampled by this package" if options.scenes is None else "official command logs"
    return {
        "Scenes": f"{source}; trials: {counts}; movies of {options.size} x {options.size} pixels",
        "Readout": "one L2 logistic regression a scenario on standardised features, C from 17 "
        "values in 1e-8 to 1e8 by stratified 5-fold cross-validation on readout trials",
        "Encoder weights": f"{options.encoder}: {options.weights}, frozen; {options.dynamics} "
        f"dynamics of 1024 hidden units, {options.steps} steps of Adam",
        "Noise of the simulation": f"{options.samples} simulations a trial from the true state at "
        "the end of the observed part; the noise scale is fitted on readout trials alone",
        "Engine": ", ".join(sorted(set(index["engine"]))),
        "Renderer": ", ".join(sorted(set(index["renderer"]))),
    }
