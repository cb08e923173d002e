"""Train the dynamics and readouts of models on a dataset and write their predictions.

Models with trained weights, such as those that ship, are not trained again. What is done is not
done again, and one evaluation that fails does not stop the others.
"""

from __future__ import annotations

import json as json_module
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from physion.analysis.tables import records
from physion.cli.arguments import take_options
from physion.cli.output import (
    Stages,
    print_line,
    print_plan,
    print_scores,
    print_warnings,
    text_table,
    write_text,
)
from physion.compute.run_tasks import ExecutorSettings
from physion.core.errors import BadInputError
from physion.core.settings import split_names
from physion.models.build import FEATURE_FILES
from physion.readout.evaluate import evaluate
from physion.readout.evaluation import EvaluatedModel, Evaluation
from physion.readout.settings import EvaluationSettings, options_by_model
from physion.readout.surprise import MEASURES as SURPRISES
from physion.readout.surprise import surprise
from physion.readout.whatif import MEASURES, TRAINING, causes, causes_line, whatif_scores
from physion.report.compare import compare
from physion.trials.dataset import Dataset

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True)
class Options:
    """Options of ``physion evaluate``."""

    models: Annotated[str, tyro.conf.Positional]
    """Names of models with commas (physion ls models lists them), FILE.py:Class, or files of
    features; may be left out with --features."""
    dataset: Annotated[Path | None, tyro.conf.Positional] = None
    """Folder of a dataset."""
    features: Path | None = None
    """File of features that were computed elsewhere (physion export --layout features-request):
    .npz, .hdf5 or .h5. It is evaluated as a model is."""
    out: Path = Path("runs/models")
    """Folder for predictions and caches."""
    fit: Path | None = None
    """Folder of another dataset, whose splits training and readout train models and fit readouts,
    in place of the dataset's own. If it has no movies, add --rendered."""
    option: tuple[str, ...] = ()
    """Settings of all models or of their training, such as encoder=resnet50 weights=random
    steps=500; of one of several models as MODEL:NAME=VALUE. Of the evaluation: folds=3, parts into
    which trials are divided where a dataset without a readout split is cross-validated (default:
    5); encoder_batch=1, clips that a network encodes at a time (default: 4; lower it when memory
    runs out); untrained=true: train no model, and take its weights as they are; benchmark=v1.5: the
    rules of physion_evaluator in place of the paper's; rollout_errors=true: also write how far the
    motion that particle models imagine is from the true one. Of the logistic regression:
    logistic.folds=3 (for the choice of its penalty), logistic.grid, logistic.seed,
    logistic.balance, logistic.released."""
    settings: Annotated[EvaluationSettings, tyro.conf.arg(name="")] = field(
        default_factory=EvaluationSettings
    )
    """Protocols, seeds, readouts, decision, cross-validation and device."""
    compute: Annotated[ExecutorSettings, tyro.conf.arg(name="")] = field(
        default_factory=ExecutorSettings
    )
    """Where tasks run: on Slurm and Ray, one model, protocol and seed is a task; on this machine a
    simulation."""
    surprise: bool = False
    """Instead of predicting outcomes, measure how much possible and impossible movies (physion
    generate --pairs) surprise the models, which are not trained for it."""
    check: bool = False
    """Before, check on about 80 trials that no prediction depends on the future, names, order,
    labels or files (physion check), and write the verdict into the table."""
    dry_run: bool = False
    """Evaluate nothing; print what would be evaluated, and what is done."""
    json: bool = False
    """Print one JSON object."""


def main(options: Options) -> int:
    """Write the tables of predictions; return 1 if some trials, or evaluations, have none."""
    settings, of_models = take_options(options.settings, options.option)
    models, dataset = _models_and_dataset(options)
    chosen = options_by_model(models, of_models)
    if options.surprise:
        return _surprise(chosen, dataset, settings, options, taken=len(of_models))
    with Stages() as stages:
        done = evaluate(
            chosen,
            Dataset(dataset),
            options.out,
            settings,
            fit=None if options.fit is None else Dataset(options.fit),
            check=options.check,
            executor=options.compute.open(),
            progress=stages,
            dry_run=options.dry_run,
            on_evaluated=stages.note_evaluated,
        )
    _print(done, options)
    return 1 if done.failed or done.problems else 0


def _models_and_dataset(options: Options) -> tuple[list[str], Path]:
    """Return the models, with the file of features, and the dataset, which may be the only word."""
    models, dataset = split_names(options.models, "model"), options.dataset
    if dataset is None:
        if options.features is None:
            raise BadInputError(f"no dataset: write physion evaluate {options.models} FOLDER")
        models, dataset = [], Path(options.models)
    if options.features is not None:
        if options.features.suffix.lower() not in FEATURE_FILES:
            raise BadInputError(
                f"a file of features ends with {', '.join(FEATURE_FILES)}, not {options.features}"
            )
        models = [*models, str(options.features)]
    return models, dataset


def _surprise(
    chosen: Mapping[str, Mapping[str, Any]],
    dataset: Path,
    settings: EvaluationSettings,
    options: Options,
    taken: int,
) -> int:
    """Print how much movies surprise the models; ``taken``: number of options of models."""
    given = {"--fit": options.fit, "--check": options.check, "--dry-run": options.dry_run}
    for name, value in given.items():
        if value:
            raise BadInputError(f"{name} does not apply to --surprise: leave it out")
    if taken < len(options.option):
        raise BadInputError("--surprise takes options of models only: leave the others out")
    with Stages() as stages:
        found = surprise(
            chosen, Dataset(dataset), options.out, settings, pixels=True, progress=stages
        )
    _print_surprise(found.scores, found.failed, options)
    return 1 if found.failed else 0


def _print(done: Evaluation, options: Options) -> None:
    if options.json:
        values: dict[str, Any] = {
            "evaluations": [_values(one) for one in done.evaluated],
            "failed": [{"cell": label, "reason": why} for label, why in done.failed.items()],
        }
        if not options.dry_run:
            values["scores"] = records(done.scores)
            changes = whatif_scores(done.predictions)
            values["whatif"] = records(changes)
            values["causes"] = records(_write_causes(done.predictions, options.out))
        print(json_module.dumps(values))
        return
    if options.dry_run:
        print_plan(done.evaluated, ["model", "protocol", "seed", "done", "path"], "evaluations")
        return
    for where, reason in done.problems.items():
        print_line(f"no prediction: {where}: {reason}")
    for label, reason in done.failed.items():
        print_line(f"failed: {label}: {reason}")
    if done.evaluated:
        print_warnings(done.warnings)
        _print_scores(done)
        _print_whatif(done.predictions, options.out)
    for one in done.evaluated:
        print_line(f"predictions: {one.path}{' (done before)' if one.done else ''}")
        if one.rollout_errors is not None:
            print_line(f"errors of imagined motion: {one.rollout_errors}")


def _print_scores(done: Evaluation) -> None:
    """Print warnings and table of results, with the study's people if they saw the stimuli."""
    try:
        result = compare(done.paths)
    except BadInputError as error:
        print_warnings([f"no comparison: {error}"])
        return
    print_warnings(result.warnings)
    print_scores(result)


def with_errors(scores: pd.DataFrame, name: str) -> list[str]:
    """Return a column of scores as texts with their standard errors, where there are any."""
    pairs = zip(scores[name], scores[f"{name}_se"], strict=True)
    return ["-" if m != m else f"{m:.3f}" if se != se else f"{m:.3f} ({se:.3f})" for m, se in pairs]


def _apart(scores: pd.DataFrame) -> list[str]:
    """Return the columns that tell trainings apart, as far as a model has several values."""
    columns = [name for name in TRAINING if name in scores]
    several = scores.groupby("model")[columns].nunique().max() > 1
    return [name for name in columns if several[name]]


def _print_whatif(predictions: pd.DataFrame, out: Path) -> None:
    """Print how predictions change with the scene, if the dataset holds variants of trials."""
    scores = whatif_scores(predictions)
    if scores.empty:
        return
    shown = scores[["model", "readout", *_apart(scores), "change", "pairs", "changed"]].copy()
    for name in MEASURES:
        shown[name] = with_errors(scores, name)
    print_line(text_table(shown, "One thing changed: mean and standard error over trials"))
    removals = _write_causes(predictions, out)
    if len(removals):
        print_line(f"{causes_line(removals)} ({out / 'causes.csv'})")


def _write_causes(predictions: pd.DataFrame, out: Path) -> pd.DataFrame:
    """Return which removals change the outcome; write them into ``out`` if there are any."""
    removals = causes(predictions)
    if len(removals):
        write_text(out / "causes.csv", removals.to_csv(index=False))
    return removals


def _print_surprise(scores: pd.DataFrame, failed: Mapping[str, str], options: Options) -> None:
    """Print how often the impossible movie of a pair surprises more, and which models failed."""
    if options.json:
        values = {
            "surprise": records(scores),
            "failed": [{"model": name, "reason": why} for name, why in failed.items()],
        }
        print(json_module.dumps(values))
        return
    for name, reason in failed.items():
        print_line(f"failed: {name}: {reason}")
    shown = scores[["model", *_apart(scores), "kind", "hidden", "pairs"]].copy()
    for name in SURPRISES:
        shown[name] = with_errors(scores, name)
    print_line(text_table(shown, "Pairs whose impossible movie surprises more (standard error)"))
    print_line(f"surprise of every movie: {options.out / 'surprise'}")


def _values(one: EvaluatedModel) -> dict[str, Any]:
    values = {
        "model": one.model,
        "protocol": one.protocol or None,
        "seed": one.seed,
        "done": one.done,
        "predictions": str(one.path),
        "problems": dict(one.problems),
    }
    if one.rollout_errors is not None:
        values["rollout_errors"] = str(one.rollout_errors)
    return values
