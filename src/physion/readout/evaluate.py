"""Evaluation of a model on a dataset: predictions of every testing trial."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

import physion
from physion.compute.executor import Executor
from physion.compute.progress import Progress
from physion.errors import BadInputError, MissingExtraError
from physion.models.interface import Encodes, Model, PredictsContact, Simulates, build_model
from physion.models.noisy_simulation import NoisySimulation
from physion.readout.contacts import ContactReadout
from physion.readout.folds import Fold, plan_folds
from physion.readout.logistic import ReadoutConfig
from physion.readout.protocols import Readout
from physion.readout.simulations import SimulationReadout
from physion.readout.table import ScenarioPredictions, make_table, read_table, write_table
from physion.training.protocols import Training
from physion.trials.dataset import Dataset

if TYPE_CHECKING:
    from physion.training.loop import TrainingConfig


_VERSION = 2
"""To be increased with every change that can alter the table of an evaluation."""


@dataclass(frozen=True)
class EvaluationConfig:
    """Settings of an evaluation."""

    readouts: tuple[str, ...] = ()
    """Protocols: observed, observed+simulated, full. Default: all that the model supports."""
    training: str = "all"
    """Scenarios that train the dynamics: all, all-but or only the tested one."""
    steps: int = 1000
    """Training steps of the dynamics."""
    batch: int = 32
    """Clips per training step."""
    learning_rate: float = 1e-3
    """Learning rate of Adam; 1e-2 in the released code."""
    readout: ReadoutConfig = field(default_factory=ReadoutConfig)
    """Settings of the readout."""
    folds: int = 5
    """Folds of the cross-validation of a dataset without a readout split."""
    seed: int = 0
    """Seed of folds and training."""
    accelerator: str = "auto"
    """Device of the networks, by Lightning's name: auto, cpu, cuda, ..."""


@dataclass(frozen=True)
class Evaluation:
    """Table of predictions, its file, and the reasons of trials that have none."""

    predictions: pd.DataFrame
    path: Path
    problems: Mapping[str, str]


def evaluate(
    dataset: Dataset,
    model: str,
    folder: Path,
    *,
    options: Mapping[str, Any] | None = None,
    config: EvaluationConfig | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Predict every testing trial of ``dataset`` with the model called ``model``.

    Parameters
    ----------
    dataset
        Trials of the splits testing, readout and training (see `plan_folds`).
    model
        Name in the registry of models.
    folder
        Output folder. The table goes to ``predictions/<model>-<hash>.csv``; caches go to
        ``features/``, ``training/`` and ``simulations/``. An existing table of the same trials,
        model and config is returned without a new evaluation.
    options
        Fields of the model's config.
    config
        Settings of the evaluation.
    executor
        Runs simulations; by default they run in this process.
    progress
        Called after every finished item.

    Raises
    ------
    BadInputError
        If a protocol does not fit the model, or no trial could be predicted.
    """
    config = config if config is not None else EvaluationConfig()
    built = build_model(model, **dict(options or {}))
    return evaluate_model(
        dataset, built, folder, config=config, executor=executor, progress=progress
    )


def evaluate_model(
    dataset: Dataset,
    model: Model,
    folder: Path,
    *,
    config: EvaluationConfig,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> Evaluation:
    """Predict every testing trial with a model that is already built; see `evaluate`."""
    provenance = model.provenance()
    readouts = _readouts(model, config)
    name = f"{provenance.model}-{_digest(dataset, model, config, readouts)[:12]}.csv"
    path = folder / "predictions" / name
    if path.is_file():
        return Evaluation(read_table(path), path, {})
    folds = plan_folds(dataset.index, Training.named(config.training), config.folds, config.seed)
    if isinstance(model, NoisySimulation):
        simulations = SimulationReadout(dataset, model, folder, executor, progress)
        simulations.prepare(folds)
        predictions = _collect(simulations.predict, folds, progress)
        problems: Mapping[str, str] = simulations.problems
    elif isinstance(model, PredictsContact):
        contacts = ContactReadout(dataset, model, progress)
        predictions, problems = _collect(contacts.predict, folds, progress), contacts.problems
    else:
        predictions = _read_features(dataset, model, folder, readouts, config, folds, progress)
        problems = {}
    if not any(part.trials for part in predictions):
        reason = next(iter(problems.values()), "there is no trial to predict")
        raise BadInputError(f"{provenance.model} predicts no trial: {reason}")
    table = make_table(predictions, provenance, dataset.index)
    if not problems:
        write_table(table, path)
        return Evaluation(read_table(path), path, {})
    # Another name than a complete table has, so that the next run retries the missing trials.
    partial = path.with_suffix(".partial.csv")
    write_table(table, partial)
    return Evaluation(read_table(partial), partial, problems)


def _read_features(
    dataset: Dataset,
    model: Model,
    folder: Path,
    readouts: tuple[Readout, ...],
    config: EvaluationConfig,
    folds: list[Fold],
    progress: Progress | None,
) -> list[ScenarioPredictions]:
    try:
        from physion.readout.features import FeatureReadout, make_fabric
    except ModuleNotFoundError as error:
        raise MissingExtraError(f"model {model.provenance().model!r}", "models") from error
    fabric = make_fabric(config.accelerator, config.seed)
    reader = FeatureReadout(
        dataset, model, readouts, _training(config), config.readout, fabric, folder, progress
    )
    return _collect(reader.predict, folds, progress)


def _collect(
    predict: Callable[[Fold], list[ScenarioPredictions]],
    folds: list[Fold],
    progress: Progress | None,
) -> list[ScenarioPredictions]:
    predictions: list[ScenarioPredictions] = []
    for done, fold in enumerate(folds, start=1):
        predictions += predict(fold)
        if progress is not None:
            progress("folds", done, len(folds))
    return predictions


def _training(config: EvaluationConfig) -> TrainingConfig:
    from physion.training.loop import TrainingConfig

    return TrainingConfig(config.steps, config.batch, config.learning_rate, config.seed)


def _readouts(model: Model, config: EvaluationConfig) -> tuple[Readout, ...]:
    """Return the requested protocols, or all that the model supports.

    Raises `BadInputError` for a protocol that the model does not support.
    """
    if isinstance(model, PredictsContact):
        possible = {Readout.OBSERVED_SIMULATED}
    elif not isinstance(model, Encodes):
        possible = set()
    elif isinstance(model, Simulates):
        possible = set(Readout)
    else:
        possible = {Readout.OBSERVED, Readout.FULL}
    requested = [Readout.named(name) for name in config.readouts]
    impossible = [readout.value for readout in requested if readout not in possible]
    if impossible or not possible:
        raise BadInputError(
            f"{model.provenance().model} does not support the readout protocol "
            f"{', '.join(impossible) or '(none at all)'}; "
            f"supported: {[readout.value for readout in Readout if readout in possible]}"
        )
    chosen = requested or [readout for readout in Readout if readout in possible]
    return tuple(readout for readout in Readout if readout in chosen)


def _digest(
    dataset: Dataset, model: Model, config: EvaluationConfig, readouts: tuple[Readout, ...]
) -> str:
    """Return the SHA-256 of all inputs of the table: trials, labels, model and config."""
    columns = ["trial", "scenario", "split", "contact", "digest", "movie_sha256"]
    columns += ["observed_movie_sha256", "recorded_contact"]
    settings = dataclasses.asdict(config)
    settings["readouts"] = [readout.value for readout in readouts]
    model_config = getattr(model, "config", None)
    options = dataclasses.asdict(model_config) if dataclasses.is_dataclass(model_config) else {}  # type: ignore[arg-type]
    parts = [_VERSION, physion.__version__, settings, dataclasses.asdict(model.provenance())]
    sha = hashlib.sha256(json.dumps([*parts, options], sort_keys=True, default=str).encode())
    if isinstance(model, Encodes):
        sha.update(model.encoder_digest().encode())
    sha.update(dataset.index[columns].to_csv(index=False).encode())
    return sha.hexdigest()
