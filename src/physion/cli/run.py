"""Run the whole pipeline: scenes, physics, rendering, trials, models, readouts, report.

Without options, a balanced sample of the official scenes that ship with the package is simulated
and rendered, models predict them, and all are compared with the people of the original study. A
second run resumes, and a larger --limit only adds.
"""

from __future__ import annotations

import json as json_module
import os
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Any

from physion.cli.output import Stages, print_line, print_scores, print_warnings
from physion.compute.local import LocalExecutor
from physion.core.errors import BadInputError
from physion.core.names import canonical_name
from physion.core.seeds import stable_hash
from physion.core.settings import split_names
from physion.data.official import PACKAGED, find_official, humans_folder, read_official_trials
from physion.models.interface import ask, can
from physion.readout.evaluate import Evaluation, evaluate
from physion.readout.settings import EvaluationSettings, choose_models, options_by_model
from physion.scenes.tdw.read_logs import ImportedTrial, TrialSet
from physion.trials.dataset import Dataset
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import (
    GenerateSettings,
    TrialTask,
    check_names,
    plan_dataset,
    plan_scenes,
)

if TYPE_CHECKING:
    import pandas as pd

    from physion.report.compare import CompareResult

OFFICIAL_MODELS = (
    "pEffNetLite0-mlp",
    "noisy-simulation",
    "gns",
    "gns-ransac",
    "dpi",
    "state-classifier",
    "constant-motion",
    "already-touched",
    "chance",
)
"""Models of a run on official scenes, in the order of the report."""
SAMPLED_MODELS = ("frozen-encoder", "noisy-simulation")
SIMULATIONS = ("noisy-simulation", "noisy-simulation-outcomes", "noisy-simulation-people")
TRAINING = {"steps": 300}
"""Settings of the training of models that learn; more steps take longer."""


@dataclass(frozen=True)
class Options:
    """Options of ``physion run``."""

    scenes: Path = Path(PACKAGED)
    """Official scenes: official (shipped with the package), a folder made by import, or one with
    command logs."""
    humans: Path | None = None
    """Answers of people to these scenes: official, or a folder with human_accuracy-*.csv. Default:
    official with the scenes of the package, else none."""
    sampled: bool = False
    """Sample scenes of Dominoes, Collide and Drop instead; nobody has seen them."""
    models: str | None = None
    """Names of models with commas (physion ls models); default: nine for official scenes."""
    out: Path | None = None
    """Folder for trials, predictions and the report; default: runs/official or runs/sampled."""
    limit: int | None = None
    """Testing trials per scenario, 10 by default, and as many for the readout (twice as many of
    sampled ones); 0 takes all official ones. Models that learn get as many sampled training trials
    as there are for the readout, which show no agent and patient."""
    size: int = 128
    """Pixels per side of the movies."""
    option: tuple[str, ...] = ()
    """Settings of the models or of their training as NAME=VALUE, such as steps=1000; of one model
    as MODEL:NAME=VALUE, such as noisy-simulation:samples=50."""
    engine: str = "physion"
    """Engine of the trials and of noisy-simulation (physion ls engines); mujoco has no cloth."""
    encoder_batch: int = 4
    """Clips that a network encodes at a time; lower it when memory runs out."""
    workers: int = os.cpu_count() or 1
    """Number of processes."""
    trial_pages: bool = False
    """Also write a page for each stimulus, to trials/ in the folder of the report."""
    json: bool = False
    """Print one JSON object instead of a table."""


def main(options: Options) -> int:
    """Run the whole pipeline, or what is missing of it; return 1 if something failed."""
    started = time.monotonic()
    humans = _humans(options)
    out = options.out or Path("runs") / ("sampled" if options.sampled else "official")
    models = model_options(options)
    # Built now, so that a wrong name or a missing library fails before trials are made.
    built = [chosen.build(0) for chosen in choose_models(models)]
    learn = any(_learns(model) for model in built)
    if options.sampled:
        plan = plan_sampled(options.limit, learn=learn)
    else:
        plan = plan_official(options.scenes, humans, options.limit, learn=learn)
    executor = LocalExecutor(workers=options.workers)
    with Stages() as stages:
        settings = GenerateSettings(
            width=options.size, height=options.size, look="split", jitters=0,
            engine=options.engine,
        )  # fmt: skip
        trials = make_trials(
            out / "trials", plan.tasks, settings, executor=executor, progress=stages
        )
    with Stages() as stages:
        done = evaluate(
            models,
            out / "trials",
            out / "models",
            EvaluationSettings(encoder_batch=options.encoder_batch),
            executor=executor,
            progress=stages,
        )
    reasons = {**trials.failed, **done.problems, **done.failed}
    failures = [*plan.failures, *(f"{where}: {why}" for where, why in reasons.items())]
    page, result = write_report(options, out, humans, plan.recorded, done)
    if options.json:
        rows = json_module.loads(result.scores.to_json(orient="records"))
        answer = {"report": str(page), "scores": rows, "failures": failures}
        print(json_module.dumps(answer, indent=1))
        return 1 if failures else 0
    for failure in failures:
        print_line(f"failed: {failure}")
    print_scores(result)
    minutes, seconds = divmod(round(time.monotonic() - started), 60)
    print_line(f"report, made in {minutes} min {seconds} s: {page}")
    return 1 if failures else 0


def _learns(model: Any) -> bool:
    """Return whether an evaluation trains a built model."""
    return can(model, "loss") and not ask(model, "trained")


def _humans(options: Options) -> Path | None:
    """Return the folder of people's answers; raise `BadInputError` if options disagree."""
    if options.sampled and options.humans is not None:
        raise BadInputError("--humans does not apply to --sampled: nobody has seen these scenes")
    least = 1 if options.sampled else 0
    if options.limit is not None and options.limit < least:
        raise BadInputError(f"--limit must be at least {least}, not {options.limit}")
    humans = options.humans
    if not options.sampled and humans is None and find_official(options.scenes) is not None:
        humans = options.scenes
    return None if humans is None else humans_folder(humans)


def model_options(options: Options) -> dict[str, dict[str, Any]]:
    """Return the models of a run and the options of each."""
    default = SAMPLED_MODELS if options.sampled else OFFICIAL_MODELS
    names = list(default) if options.models is None else split_names(options.models, "model")
    presets: dict[str, dict[str, Any]] = {
        # Frames of the size of the movies: enlarging them would only take time.
        "pEffNetLite0-mlp": {"image_size": options.size},
        "pEffNetLite0-lstm": {"image_size": options.size},
        "frozen-encoder": {"encoder": "resnet18", "weights": "random"},
        **{name: {"samples": 20, "engine": options.engine} for name in SIMULATIONS},
    }
    known = {name: {**TRAINING, **presets.get(name, {})} for name in names}
    return options_by_model(names, options.option, known)


def write_report(
    options: Options, out: Path, humans: Path | None, recorded: Mapping[str, bool], done: Evaluation
) -> tuple[Path, CompareResult]:
    """Write the report; return its page and the comparison."""
    from physion.report.compare import compare
    from physion.report.html import movies_of

    dataset = Dataset(out / "trials")
    labels = {canonical_name(name): contact for name, contact in recorded.items()}
    result = compare(done.paths, humans=humans, labels=labels or None)
    page = result.report(
        out / "report",
        methods=methods(options, dataset.index),
        movies=movies_of(dataset.folder),
        question="Will the red object touch the yellow one?",
        trial_pages=options.trial_pages,
    )
    print_warnings([*done.warnings, *result.warnings])
    return page, result


def methods(options: Options, index: pd.DataFrame) -> dict[str, str]:
    """Return the settings of a run as texts for the report."""
    splits = index.groupby("split").size()
    counts = ", ".join(f"{count} {split}" for split, count in splits.items())
    source = "sampled by this package" if options.sampled else "official scenes"
    return {
        "Scenes": f"{source}; trials: {counts}; movies of {options.size} x {options.size} pixels",
        "Readout": "one L2 logistic regression per scenario on standardised features, C from 17 "
        "values in 1e-8 to 1e8 by stratified 5-fold cross-validation on readout trials",
        "Training": f"models that learn: {TRAINING['steps']} steps on the training trials, which "
        "show no agent and patient, no labels"
        + (f"; options: {' '.join(options.option)}" if options.option else ""),
        "Noise of the simulation": "20 simulations per trial from the true state at the end of the "
        "observed part; the noise scale is fitted on readout trials only",
        "Engine": ", ".join(sorted(set(index["engine"]))),
        "Renderer": ", ".join(sorted(set(index["renderer"]))),
    }


# Trials of a run: the official scenes that people saw, or sampled ones.

SAMPLED_SCENARIOS = ("dominoes", "collide", "drop")
LIMIT = 10
"""Testing trials of a scenario, if no number is asked for."""


@dataclass(frozen=True)
class RunPlan:
    """Trials to make, recorded outcomes by stimulus, and failures of the import."""

    tasks: list[TrialTask]
    recorded: Mapping[str, bool]
    failures: list[str]


def plan_sampled(limit: int | None, *, learn: bool = False) -> RunPlan:
    """Plan a small set of sampled trials: testing, and twice as many for the readout.

    With ``learn`` there are as many training trials as for the readout.
    """
    count = LIMIT if limit is None else limit
    counts = {"readout": 2 * count, "testing": count, **({"training": 2 * count} if learn else {})}
    return RunPlan(plan_dataset("sampled", SAMPLED_SCENARIOS, counts), {}, [])


def plan_official(
    scenes: Path, humans: Path | None, limit: int | None, *, learn: bool = False
) -> RunPlan:
    """Plan official scenes: those that people saw are tested, others fit models and readouts.

    ``limit`` is the number of testing trials of a scenario, balanced by recorded outcome; as many
    others are fitted. 0 takes all. With ``learn``, as many training trials are sampled.
    """
    from physion.analysis.tables import read_humans

    limit = LIMIT if limit is None else limit or None
    seen = set(read_humans(humans)["stimulus"]) if humans is not None else None
    logs = read_official_trials(scenes)
    logs.require_trials()
    recorded = {trial.scene.name: trial.outcome.contact for trial in logs.trials}
    parts: dict[str, list[ImportedTrial]] = {"testing": [], "readout": []}
    for trial in _once(logs):
        # Familiarization trials are neither tested nor fitted.
        if "familiarization" not in trial.scene.name:
            tested = seen is None or canonical_name(trial.scene.name) in seen
            parts["testing" if tested else "readout"].append(trial)
    # Scenes with the physics of a tested one are not fitted.
    known = {trial.scene.physics_digest() for trial in parts["testing"]}
    parts["readout"] = [t for t in parts["readout"] if t.scene.physics_digest() not in known]
    tasks: list[TrialTask] = []
    for split, trials in parts.items():
        chosen = [trial.scene for trial in balanced_trials(trials, limit)]
        tasks += plan_scenes("official", chosen, split, recorded)
        if learn and split == "readout":
            for scenario, count in Counter(scene.scenario for scene in chosen).items():
                tasks += plan_dataset("official", (scenario,), {"training": count})
    if not any(task.split == "testing" for task in tasks):
        raise BadInputError(f"none of the scenes in {scenes} is in {humans}")
    check_names(tasks)
    return RunPlan(tasks, recorded, [str(failure) for failure in logs.failures])


def _once(logs: TrialSet) -> list[ImportedTrial]:
    """Return the trials without copies; raise `BadInputError` if two of one name differ."""
    found: dict[str, ImportedTrial] = {}
    for trial in logs.trials:
        name = trial.scene.name
        first = found.setdefault(name, trial)
        if first is not trial and trial.scene.physics_digest() != first.scene.physics_digest():
            files = " and ".join(str(path) for path in logs.logs[name][:2])
            raise BadInputError(f"two trials are called {name!r}, in {files}; give one folder")
    return list(found.values())


def balanced_trials(trials: Iterable[ImportedTrial], limit: int | None) -> list[ImportedTrial]:
    """Return at most ``limit`` trials per scenario, with and without contact alternately.

    The choice depends on names and outcomes only; a larger limit includes the trials of a smaller
    one. Without a limit all trials are returned.
    """
    groups: dict[str, list[ImportedTrial]] = defaultdict(list)
    for trial in sorted(trials, key=lambda trial: stable_hash("limit", trial.scene.name)):
        groups[trial.scene.scenario].append(trial)
    # Scenarios begin with either kind, so that one trial of each is balanced, too.
    ordered = sorted(groups)
    return [
        trial
        for place, scenario in enumerate(ordered)
        for trial in _alternating(groups[scenario], first=place % 2 == 0)[:limit]
    ]


def _alternating(trials: Sequence[ImportedTrial], *, first: bool) -> list[ImportedTrial]:
    """Return trials with the outcome ``first`` and with the other, alternately.

    What is left of the more frequent kind comes last.
    """
    same = [trial for trial in trials if trial.outcome.contact == first]
    others = [trial for trial in trials if trial.outcome.contact != first]
    pairs = zip_longest(same, others)
    return [trial for pair in pairs for trial in pair if trial is not None]
