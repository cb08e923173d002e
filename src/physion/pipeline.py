"""The whole pipeline in one call: scenes, physics, rendering, trials, models, readouts, report."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Annotated, Any

import pandas as pd

from physion.analysis.tables import read_humans
from physion.compute.local import LocalExecutor
from physion.compute.run_tasks import run_tasks
from physion.compute.tasks import Executor, Progress, tracked
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import is_whole, write_with_digest
from physion.core.names import canonical_name
from physion.core.seeds import stable_hash
from physion.core.settings import OPTION_ONLY, split_names
from physion.data.official import PACKAGED, find_official, humans_folder, read_official_trials
from physion.models.interface import Model, ask, can
from physion.readout.evaluate import evaluate
from physion.readout.evaluation import EvaluatedModel, Evaluation
from physion.readout.logistic import LogisticSettings
from physion.readout.predictor import build_decision
from physion.readout.settings import EvaluationSettings, choose_models
from physion.readout.shipped import find_readouts
from physion.report.compare import CompareResult, compare
from physion.report.inputs import ReportInputs
from physion.report.trials import shown_stimuli
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
from physion.trials.trial_file import Trial

OFFICIAL_MODELS = (
    "state-trees",
    "constant-motion",
    "already-touched",
    "chance",
    "intuition-states",
    "noisy-simulation",
    "dpi",
    "gns",
    "intuition-masks",
    "intuition-pixels",
    "blob-trees",
    "rpin",
    "pEffNetLite0-mlp",
)
"""Models of a run on official scenes; those that take no time come first, so that rows appear. An
encoder whose readouts ship has a twin with random weights."""
SAMPLED_MODELS = ("frozen-encoder", "noisy-simulation")
SAMPLED_SCENARIOS = ("dominoes", "collide", "drop")
LIMIT = 10
"""Testing trials of a scenario, if no number is asked for."""
SIMULATIONS = ("noisy-simulation", "noisy-simulation-outcomes", "noisy-simulation-people")
TRAINING = {"steps": 300}
"""Settings of the training of models that learn; more steps take longer."""


@dataclass(frozen=True)
class RunSettings:
    """Settings of `run`."""

    scenes: Path = Path(PACKAGED)
    """Official scenes: official (shipped with the package), a folder made by import, or one with
    command logs, which are looked for in all folders in it."""
    humans: Path | None = None
    """Answers of people to these scenes: official, or a folder with human_accuracy-*.csv. Default:
    official with the scenes of the package, else none."""
    sampled: bool = False
    """Sample scenes of Dominoes, Collide and Drop instead; nobody has seen them."""
    models: str | None = None
    """Names of models with commas (physion ls models); default: for official scenes thirteen, and
    the random twin of one."""
    out: Path | None = None
    """Folder for trials, predictions and the report; default: runs/official or runs/sampled."""
    limit: int | None = None
    """Testing trials per scenario, and as many for the readout (twice as many with --sampled).
    Default: 10; 0 takes all official ones. Models that learn get as many sampled training trials,
    which show no agent and patient."""
    size: int = 128
    """Pixels per side of the movies of the page; every model sees pictures of its own size."""
    decision: str = ""
    """What turns features or rollouts into P(contact) (physion ls decisions), for the models that
    can use it; default: the model's own."""
    engine: str = "physion"
    """Engine of the trials and of noisy-simulation (physion ls engines); mujoco has no cloth."""
    encoder_batch: Annotated[int, OPTION_ONLY] = 4
    """Clips that a network encodes at a time; lower it when memory runs out."""
    workers: int = os.cpu_count() or 1
    """Number of processes."""


@dataclass(frozen=True)
class Run:
    """What `run` did.

    - ``report``: the page. ``result``: the comparison that it shows.
    - ``evaluation``: predictions of the models.
    - ``failures``: reasons of scenes, trials and models that failed, one sentence each.
    """

    report: Path
    result: CompareResult
    evaluation: Evaluation
    failures: Sequence[str]

    @property
    def warnings(self) -> list[str]:
        """What may make the results wrong, one sentence each."""
        return [*self.evaluation.warnings, *self.result.warnings]


def run(
    settings: RunSettings | None = None,
    *,
    options: Mapping[str, Mapping[str, Any]] | None = None,
    progress: Progress | None = None,
    on_evaluated: Callable[[EvaluatedModel], None] | None = None,
    **changes: Any,
) -> Run:
    """Make trials, let models predict them, compare all with people, and write the report.

    Without settings, a balanced sample of the official scenes that ship with the package is
    simulated, and thirteen models, with the random twin of one, are compared with the people of the
    original study. A second run resumes, and a larger ``limit`` only adds.

    Parameters
    ----------
    settings
        Scenes, models, folder and sizes.
    options
        Options of models, or of their training, by the name of the model.
    progress
        Called after every finished item.
    on_evaluated
        Called with each model when it has predicted.
    **changes
        Fields of `RunSettings` to replace in ``settings``, such as ``limit=2``.

    Returns
    -------
    run
        Page, comparison and predictions, and what failed.

    Raises
    ------
    BadInputError
        Before anything is made, if settings contradict each other or a model cannot be built.
    """
    settings = replace(settings or RunSettings(), **changes)
    humans = _humans(settings)
    out = settings.out or Path("runs") / ("sampled" if settings.sampled else "official")
    models = model_options(settings, options or {})
    # Built now, so that a wrong name or a missing library fails before trials are made.
    chosen = choose_models(models)
    building = tracked(chosen, "building models", len(chosen), progress)
    built = {one.name: one.build(0) for one in building}
    decided = decided_models(built, settings.decision)
    encoders = [
        name for name, model in built.items()
        if name not in decided and _learns(model) and find_readouts(model)
    ]  # fmt: skip
    learn = any(_learns(model) for name, model in built.items() if name not in encoders)
    for _ in tracked((None,), "reading scenes", 1, progress):
        if settings.sampled:
            plan = plan_sampled(settings.limit, learn=learn)
        else:
            plan = plan_official(settings.scenes, humans, settings.limit, learn=learn)
    executor = LocalExecutor(workers=settings.workers)
    making = GenerateSettings(
        width=settings.size, height=settings.size, look="split", jitters=0, movies=False,
        engine=settings.engine,
    )  # fmt: skip
    trials = make_trials(out / "trials", plan.tasks, making, executor=executor, progress=progress)
    do = partial(
        evaluate,
        dataset=out / "trials",
        out=out / "models",
        settings=EvaluationSettings(encoder_batch=settings.encoder_batch),
        executor=executor,
        progress=progress,
        on_evaluated=on_evaluated,
    )
    # What encoders imagine would have to be trained, and whole movies take longer than all the
    # rest: only readouts of the observed part are used. Of RPIN only those that ship, for the same
    # reason (physion evaluate has all).
    others = [name for name in models if name not in (*decided, *encoders)]
    kinds = {name: _shipped_kinds(built[name]) for name in others}
    groups: list[tuple[Sequence[str], dict[str, Any]]] = [
        (decided, {"decision": settings.decision}),
        ([name for name in others if not kinds[name]], {}),
        *(([name], {"readouts": kinds[name]}) for name in others if kinds[name]),
        (encoders, {"readouts": ("observed",), "twin": settings.models is None}),
    ]
    done = Evaluation([], {})
    for names, special in groups:
        if names:
            more = do({name: models[name] for name in names}, **special)
            done = Evaluation([*done.evaluated, *more.evaluated], {**done.failed, **more.failed})
    reasons = {**trials.failed, **done.problems, **done.failed}
    failures = [*plan.failures, *(f"{where}: {why}" for where, why in reasons.items())]
    dataset = Dataset(out / "trials")
    labels = {canonical_name(name): contact for name, contact in plan.recorded.items()}
    for _ in tracked((None,), "comparing", 1, progress):
        result = compare(done.paths, humans=humans, labels=labels or None)
    page = result.report(
        out / "report",
        methods=methods(settings, dataset.index, options or {}, built, models, decided, encoders),
        movies=page_movies(settings, dataset, result, out / "movies", executor, progress),
        question="Will the red object touch the yellow one?",
    )
    return Run(page, result, done, failures)


def _learns(model: Any) -> bool:
    """Return whether an evaluation trains a built model."""
    return can(model, "loss") and not ask(model, "trained")


def _shipped_kinds(model: Any) -> tuple[str, ...]:
    """Return the kinds of readouts that ship for a built model."""
    shipped = find_readouts(model)
    return () if shipped is None else shipped.kinds


def decided_models(built: Mapping[str, Model], decision: str) -> list[str]:
    """Return the names of the models that a decision fits; none without a decision.

    Raises `BadInputError` if it fits none.
    """
    if not decision:
        return []
    found, reasons = [], []
    for name, model in built.items():
        try:
            build_decision(model, decision, LogisticSettings())
            found.append(name)
        except UnknownNameError:
            raise
        except BadInputError as error:
            reasons.append(str(error))
    if not found:
        raise BadInputError(reasons[0])
    return found


def _humans(settings: RunSettings) -> Path | None:
    """Return the folder of people's answers; raise `BadInputError` if settings disagree."""
    if settings.sampled and settings.humans is not None:
        raise BadInputError("--humans does not apply to --sampled: nobody has seen these scenes")
    least = 1 if settings.sampled else 0
    if settings.limit is not None and settings.limit < least:
        raise BadInputError(f"--limit must be at least {least}, not {settings.limit}")
    humans = settings.humans
    if not settings.sampled and humans is None and find_official(settings.scenes) is not None:
        humans = settings.scenes
    return None if humans is None else humans_folder(humans)


def chosen_models(settings: RunSettings) -> list[str]:
    """Return the names of the models of a run."""
    if settings.models is not None:
        return split_names(settings.models, "model")
    return list(SAMPLED_MODELS if settings.sampled else OFFICIAL_MODELS)


def model_options(
    settings: RunSettings, options: Mapping[str, Mapping[str, Any]]
) -> dict[str, dict[str, Any]]:
    """Return the models of a run and the options of each; ``options`` come before our own."""
    presets: dict[str, dict[str, Any]] = {
        "frozen-encoder": {"encoder": "resnet18", "weights": "random"},
        # One level of noise: choosing among three would take six times as many simulations.
        **{
            name: {"samples": 20, "scales": (1.0,), "engine": settings.engine}
            for name in SIMULATIONS
        },
    }
    return {
        name: {**TRAINING, **presets.get(name, {}), **options.get(name, {})}
        for name in chosen_models(settings)
    }


def page_movies(
    settings: RunSettings,
    dataset: Dataset,
    result: CompareResult,
    folder: Path,
    executor: Executor,
    progress: Progress | None,
) -> dict[str, Path]:
    """Make the movies that the page shows, or links to because the outcome differs; return them.

    Models see pictures that are rendered when they are read, so that other movies are not needed.
    """
    assert isinstance(result.inputs, ReportInputs)
    names = {canonical_name(trial): trial for trial in dataset.trials("testing")}
    tested = {stimulus: folder / f"{trial}.mp4" for stimulus, trial in names.items()}
    inputs = replace(result.inputs, movies=tested)
    wanted = [*shown_stimuli(inputs), *inputs.comparison.changed["stimulus"]]
    movies = {stimulus: tested[stimulus] for stimulus in dict.fromkeys(wanted)}
    tasks = {
        names[stimulus]: (dataset.paths(names[stimulus]).trial_file, path)
        for stimulus, path in movies.items()
        if not is_whole(path)
    }
    folder.mkdir(parents=True, exist_ok=True)
    _, failed = run_tasks(
        _make_movie, tasks, folder=folder, what="movies", executor=executor, progress=progress
    )
    return {stimulus: path for stimulus, path in movies.items() if names[stimulus] not in failed}


def _make_movie(task: tuple[Path, Path]) -> None:
    """Render the movie of a trial file."""
    # Imported late: loading the compiled renderer takes time.
    from physion.trials.making.make import make_movies

    trial = Trial.open(task[0])
    movie, _ = make_movies(trial.renderer(), trial.metadata.playback_rate)
    write_with_digest(task[1], movie)


def methods(
    settings: RunSettings,
    index: pd.DataFrame,
    options: Mapping[str, Mapping[str, Any]],
    built: Mapping[str, Any],
    models: Mapping[str, Mapping[str, Any]],
    decided: Sequence[str],
    encoders: Sequence[str],
) -> dict[str, str]:
    """Return the settings of a run as texts for the report.

    ``options``: what the user gave. ``built``, ``models``: the models, and all their options.
    ``decided``: models with the decision that was asked for. ``encoders``: models that learn and
    are not trained, since only their readouts that ship are used.
    """
    splits = index.groupby("split").size()
    counts = ", ".join(f"{count} {split}" for split, count in splits.items())
    source = "sampled by this package" if settings.sampled else "official scenes"
    given = [f"{m}:{n}={v}" for m, own in options.items() for n, v in own.items()]
    trained = [name for name in built if _learns(built[name]) and name not in encoders]
    steps = [f"{name} {models[name]['steps']} steps" for name in trained]
    samples = [f"{name} {models[name]['samples']}" for name in built if name in SIMULATIONS]
    texts = {
        "Scenes": f"{source}; trials: {counts}; every model sees pictures of its own "
        "size, rendered when they are read",
        "Readout": "those that ship, fitted on sampled trials, where there are some for the model; "
        "else one L2 logistic regression per scenario on standardised features, C from 17 "
        "values in 1e-8 to 1e8 by stratified 5-fold cross-validation on readout trials",
        "Engine": ", ".join(sorted(set(index["engine"]))),
        "Renderer": ", ".join(sorted(set(index["renderer"]))),
    }
    if steps:
        texts["Training"] = (
            f"{', '.join(steps)}, on the training trials, which show no agent and patient, "
            "without labels"
        )
    texts["Noise of the simulation"] = "no model of this run simulates with noise"
    if samples:
        texts["Noise of the simulation"] = (
            f"simulations per trial: {', '.join(samples)}, from the true state at the end of the "
            "observed part; where several noise scales are offered, readout trials choose"
        )
    if settings.decision:
        texts["Decision"] = f"{settings.decision} in place of the own one: {', '.join(decided)}"
    if given:
        texts["Options"] = " ".join(given)
    return texts


# Trials of a run: the official scenes that people saw, or sampled ones.


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
        # Of an odd number, more of the fitted trials have the outcome that fewer tested ones have.
        other = split == "readout" and limit is not None and limit % 2 == 1
        balanced = balanced_trials(trials, limit, contact_first=not other)
        chosen = [trial.scene for trial in balanced]
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


def balanced_trials(
    trials: Iterable[ImportedTrial], limit: int | None, *, contact_first: bool = True
) -> list[ImportedTrial]:
    """Return at most ``limit`` trials per scenario, with and without contact alternately.

    The choice depends on names and outcomes only; a larger limit includes the trials of a smaller
    one. Without a limit all trials are returned. ``contact_first``: outcome of the first trial of
    the first scenario.
    """
    groups: dict[str, list[ImportedTrial]] = defaultdict(list)
    for trial in sorted(trials, key=lambda trial: stable_hash("limit", trial.scene.name)):
        groups[trial.scene.scenario].append(trial)
    # Scenarios begin with either kind, so that one trial of each is balanced, too.
    ordered = sorted(groups)
    return [
        trial
        for place, scenario in enumerate(ordered)
        for trial in _alternating(groups[scenario], first=(place % 2 == 0) == contact_first)[:limit]
    ]


def _alternating(trials: Sequence[ImportedTrial], *, first: bool) -> list[ImportedTrial]:
    """Return trials with the outcome ``first`` and with the other, alternately.

    What is left of the more frequent kind comes last.
    """
    same = [trial for trial in trials if trial.outcome.contact == first]
    others = [trial for trial in trials if trial.outcome.contact != first]
    pairs = zip_longest(same, others)
    return [trial for pair in pairs for trial in pair if trial is not None]
