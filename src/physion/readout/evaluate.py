"""Predict the trials of a dataset with models: the function behind ``physion evaluate``."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from physion.compute.tasks import Executor, Progress
from physion.readout.check import check_models
from physion.readout.evaluation import EvaluatedModel, Evaluation, run_evaluations
from physion.readout.settings import EvaluationSettings, Models, choose_models
from physion.trials.dataset import Dataset


def evaluate(
    models: Models,
    dataset: Dataset | Path | str,
    out: Path | str = "runs/models",
    settings: EvaluationSettings | None = None,
    *,
    fit: Dataset | Path | str | None = None,
    check: bool = False,
    options: Mapping[str, Any] | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
    dry_run: bool = False,
    on_evaluated: Callable[[EvaluatedModel], None] | None = None,
    **changes: Any,
) -> Evaluation:
    """Train models and their readouts, and predict every testing trial of a dataset.

    Parameters
    ----------
    models
        Name of a model (``physion ls models``), ``FILE.py:Class``, a file of features that were
        computed elsewhere, or a model; or several of them, or names with options of their own.
        Models with trained weights are not trained again.
    dataset
        Trials of the splits testing, readout and training, or the path of their folder. Without
        readout trials the testing trials are cross-validated.
    out
        Output folder. Tables go to ``predictions/<model>-<hash>.csv``, caches to ``features/`` and
        ``training/``, errors of imagined motion (`rollout_error`) to ``rollout-errors/``. A table
        whose inputs are the same is not made again.
    settings
        Protocols, seeds, readouts, decision, cross-validation and device. Readouts that ship for a
        model (`physion.readout.shipped`) are used where they fit, unless ``readout_from="fit"``.
    fit
        Another dataset, whose trials of the splits training and readout take the place of the
        dataset's own, as in the paper. No motion may be in both, and look, frame rate and size of
        the movies must agree; a set without movies needs ``rendered``.
    check
        Whether each model is first checked on about 80 trials, with the changes that must not move
        a prediction (`physion.check`); the verdict stands in the column ``check`` of the table.
    options
        Fields of the settings of the models, or of their training (`TrainingSettings`).
    executor
        Runs the evaluations, each a task, but a `LocalExecutor` the simulations of one evaluation
        after the other (`runner_of_cells`). By default all run in this process.
    progress
        Called after every finished item.
    dry_run
        Only say what would be evaluated, and what is done.
    on_evaluated
        Called with each evaluation when it is finished.
    **changes
        Fields of `EvaluationSettings` to replace in ``settings``, such as ``seeds=3``.

    Returns
    -------
    Evaluation
        Tables, accuracies, and what failed; one evaluation that fails does not stop the others.

    Raises
    ------
    UnknownNameError
        For an unknown model, option, protocol, readout or decision; the message names the closest.
    BadInputError
        If a model cannot be built, or the only evaluation fails: a readout does not fit the model,
        the model raises or returns something wrong, or no trial could be predicted.
    """
    settings = dataclasses.replace(settings or EvaluationSettings(), **changes)
    chosen, verdicts = choose_models(models, options), {}
    if check and not dry_run:
        verdicts = check_models(
            chosen, dataset, Path(out) / "check", settings, executor=executor, progress=progress
        )
    return run_evaluations(
        chosen,
        dataset,
        Path(out),
        settings,
        fit=fit,
        verdicts=verdicts,
        executor=executor,
        progress=progress,
        dry_run=dry_run,
        on_evaluated=on_evaluated,
    )
