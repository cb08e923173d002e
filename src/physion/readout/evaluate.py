"""Evaluation of a model on a dataset: predictions of every testing trial."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from physion.clips.batch import Provenance
from physion.compute.tasks import Executor, Progress, tracked
from physion.core.errors import BadInputError
from physion.core.files import is_whole
from physion.core.version import __version__
from physion.models.build import build_model
from physion.models.interface import Model, ask, can
from physion.readout.folds import Fold, plan_folds, select_scenario
from physion.readout.model_calls import check_identity
from physion.readout.predictor import Predictor, choose_readouts
from physion.readout.protocols import Readout
from physion.readout.rollout_error import check_moves_objects, rollout_error
from physion.readout.settings import EvaluationConfig
from physion.readout.tables import (
    ORDER,
    Evaluation,
    ScenarioPredictions,
    file_name,
    make_table,
    read_table,
    write_table,
)
from physion.training.protocols import Training
from physion.trials.dataset import Dataset

PARTS = "parts"
"""Folder of the tables of single scenarios."""
_VERSION = 5
"""To be increased with every change that can alter the table of an evaluation."""


def evaluate(
    dataset: Dataset,
    model: Model | str,
    folder: Path | str,
    *,
    options: Mapping[str, Any] | None = None,
    config: EvaluationConfig | None = None,
    rollout_errors: bool = False,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Train a model and its readout, and predict every testing trial of a dataset.

    Parameters
    ----------
    dataset
        Trials of the splits testing, readout and training. Without readout trials the testing
        trials are cross-validated.
    model
        Name of a model (``physion ls models``), ``FILE.py:Class``, or a model.
    folder
        Output folder. The table goes to ``predictions/<model>-<hash>.csv``; caches go to
        ``features/``, ``training/`` and ``rollouts/``. An existing table of the same trials,
        model and config is returned without a new evaluation. Under all-but and only, each tested
        scenario has a table in ``predictions/parts/`` as soon as it is predicted.
    options
        Fields of the config of a model that is given by its name.
    config
        Protocols, training, readout and device.
    rollout_errors
        Also write the errors of imagined motion over time (`rollout_error`) to
        ``rollout-errors/``, in a file of the same name; for models that move objects.
    executor
        Runs simulations; by default they run in this process.
    progress
        Called after every finished item.

    Returns
    -------
    evaluation
        Table of predictions with the official column names, a row for each testing trial and
        protocol; its file; and the reasons of trials that have no prediction.

    Raises
    ------
    UnknownNameError
        For an unknown model, option, protocol or reader; the message names the closest ones.
    BadInputError
        If a protocol does not fit the model, the model raises or returns something wrong, or no
        trial could be predicted.
    """
    config = config if config is not None else EvaluationConfig()
    if isinstance(model, str):
        model = build_model(model, **dict(options or {}))
    elif options:
        raise BadInputError("options are for a model that is given by its name; this one is built")
    return evaluate_model(
        dataset,
        model,
        Path(folder),
        config=config,
        rollout_errors=rollout_errors,
        executor=executor,
        progress=progress,
    )


def evaluate_model(
    dataset: Dataset,
    model: Model,
    folder: Path,
    *,
    config: EvaluationConfig,
    rollout_errors: bool = False,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Predict every testing trial with a model that is already built; see `evaluate`.

    A model that is trained has its initial weights afterwards.
    """
    provenance = _provenance(model)
    chosen = choose_readouts(model, config.readouts, config.reader)
    name = f"{file_name(provenance.model)}-{_digest(dataset, model, config, chosen)[:12]}.csv"
    part = PARTS if config.scenario else ""
    path = folder / "predictions" / part / name
    errors_path = folder / "rollout-errors" / part / name if rollout_errors else None
    if errors_path is not None:
        check_moves_objects(model)
    if is_whole(path) and (errors_path is None or is_whole(errors_path)):
        return Evaluation(read_table(path), path, {}, errors_path)
    protocol = Training.named(config.training)
    folds = plan_folds(dataset.index, protocol, config.folds, config.seed)
    kept = select_scenario([fold.training.name for fold in folds], protocol, config.scenario)
    if config.scenario or protocol is Training.ALL:
        predictor = Predictor(dataset, model, chosen, config, folder, executor, progress)
        try:
            chosen_folds = [folds[position] for position in kept]
            tables = _predict(predictor, chosen_folds, provenance, rollout_errors)
        finally:
            predictor.restore()
        problems = predictor.problems
    else:
        # One table for each tested scenario, so that what is done is not done again.
        parts = [
            evaluate_model(
                dataset,
                model,
                folder,
                config=dataclasses.replace(config, scenario=scenario),
                rollout_errors=rollout_errors,
                executor=executor,
                progress=progress,
            )
            for scenario in sorted({s.scenario for fold in folds for s in fold.scenarios})
        ]
        tables = _joined(parts)
        problems = {trial: why for part in parts for trial, why in part.problems.items()}
    if not len(tables[0]) and not config.scenario:
        reason = next(iter(problems.values()), "there is no trial to predict")
        raise BadInputError(f"{provenance.model} predicts no trial: {reason}")
    # Another name than a complete table has, so that the next run retries the missing trials.
    path = path.with_suffix(".partial.csv") if problems else path
    write_table(tables[0], path)
    if errors_path is not None:
        errors_path = errors_path.with_name(path.name)
        write_table(tables[1], errors_path)
    return Evaluation(read_table(path), path, problems, errors_path)


def _predict(
    predictor: Predictor, folds: Sequence[Fold], provenance: Provenance, rollout_errors: bool
) -> list[pd.DataFrame]:
    """Return the table of predictions of ``folds``, and that of errors of imagined motion."""
    dataset, model = predictor.dataset, predictor.model
    predictions: list[ScenarioPredictions] = []
    errors: list[pd.DataFrame] = []
    for fold in tracked(folds, "folds", len(folds), predictor.progress):
        predictions += predictor.predict(fold)
        if rollout_errors:
            # Now, since the model has the weights that were trained for this fold.
            tested = [t for split in fold.scenarios for t in split.test]
            known = [t for t in tested if t not in predictor.problems]
            errors.append(rollout_error(dataset, model, known, progress=predictor.progress))
    tables = [make_table(predictions, provenance, dataset.index)]
    return [*tables, pd.concat(errors, ignore_index=True).round(6)] if errors else tables


def _joined(parts: Sequence[Evaluation]) -> list[pd.DataFrame]:
    """Return the tables of all parts as one each, with the text of every number."""

    def read(path: Path) -> pd.DataFrame:
        return pd.read_csv(path, dtype=str, keep_default_na=False)

    table = pd.concat([read(part.path) for part in parts], ignore_index=True)
    errors = [read(part.rollout_errors) for part in parts if part.rollout_errors is not None]
    tables = [table.sort_values(list(ORDER), ignore_index=True)]
    return [*tables, pd.concat(errors, ignore_index=True)] if errors else tables


def _provenance(model: Model) -> Provenance:
    """Return the provenance of a model, with the inputs of its `Spec` if it names no others."""
    known = check_identity(model)
    return dataclasses.replace(known, inputs=known.inputs or ", ".join(model.spec.inputs))


def _digest(
    dataset: Dataset, model: Model, config: EvaluationConfig, readouts: Iterable[Readout]
) -> str:
    """Return the SHA-256 of all inputs of the table: trials, labels, model and config."""
    columns = ["trial", "scenario", "split", "contact", "digest", "movie_sha256"]
    columns += ["observed_movie_sha256", "recorded_contact", "observed_contact"]
    settings = dataclasses.asdict(config)
    settings["readouts"] = [readout.value for readout in readouts]
    options = dataclasses.asdict(chosen) if (chosen := ask(model, "settings")) else {}
    if can(model, "loss"):
        options["training settings"] = dataclasses.asdict(
            config.apply(ask(model, "training_settings"))
        )
    parts = [_VERSION, __version__, settings, dataclasses.asdict(model.provenance())]
    sha = hashlib.sha256(json.dumps([*parts, options], sort_keys=True, default=str).encode())
    sha.update(model.digest().encode())
    sha.update(dataset.index[columns].to_csv(index=False).encode())
    return sha.hexdigest()
