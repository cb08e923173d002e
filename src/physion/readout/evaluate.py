"""From a dataset and a model to a table of predictions."""

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
from physion.errors import BadInputError, MissingExtraError
from physion.models.interface import Encodes, Model, PredictsContact, Simulates, build_model
from physion.models.noisy_simulation import NoisySimulation
from physion.readout.contacts import ContactReadout
from physion.readout.folds import Round, plan_rounds
from physion.readout.logistic import ReadoutConfig
from physion.readout.protocols import Readout
from physion.readout.simulations import SimulationReadout
from physion.readout.table import Answers, make_table, read_table, write_table
from physion.training.protocols import Training
from physion.trials.dataset import Dataset

if TYPE_CHECKING:
    from physion.training.loop import TrainingConfig

Progress = Callable[[str, int, int], None]
"""Called with what is being done, how many are done, and how many there are."""

_VERSION = 1
"""Raised whenever the same evaluation could give other predictions."""


@dataclass(frozen=True)
class EvaluationConfig:
    """How models are evaluated."""

    readouts: tuple[str, ...] = ()
    """Protocols by name (observed, observed+simulated, full); empty: all that the model can do."""
    training: str = "all"
    """Which scenarios train the dynamics: all, all-but, or only."""
    steps: int = 1000
    """Training steps of the dynamics."""
    batch: int = 32
    """Clips a training step."""
    learning_rate: float = 1e-3
    """Learning rate of Adam; the released code had 1e-2."""
    readout: ReadoutConfig = field(default_factory=ReadoutConfig)
    """How a readout is fitted."""
    folds: int = 5
    """Parts of the cross-fit of a dataset without a readout split."""
    seed: int = 0
    """Seed of folds and training."""
    accelerator: str = "auto"
    """Where networks run, by Lightning's name: auto, cpu, cuda, ..."""


@dataclass(frozen=True)
class Evaluation:
    """The table of predictions, its file, and the trials without one with the reason."""

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
    """Predict every testing trial of ``dataset`` by the model called ``model``.

    ``options`` are fields of the model's config. Everything goes below ``folder``: the table in
    ``predictions/<model>-<hash>.csv``, and what makes a second run quick in ``features/``,
    ``training/`` and ``simulations/``. A table that is there already, of the same trials, model
    and config, is returned as it is. ``executor`` runs simulations, by default in this process.
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
    """`evaluate` for a model that is built already."""
    provenance = model.provenance()
    readouts = _readouts(model, config)
    name = f"{provenance.model}-{_digest(dataset, model, config, readouts)[:12]}.csv"
    path = folder / "predictions" / name
    if path.is_file():
        return Evaluation(read_table(path), path, {})
    rounds = plan_rounds(dataset.index, Training.named(config.training), config.folds, config.seed)
    if isinstance(model, NoisySimulation):
        simulations = SimulationReadout(dataset, model, folder, executor, progress)
        simulations.prepare(rounds)
        answers = _collect(simulations.answers, rounds, progress)
        problems: Mapping[str, str] = simulations.problems
    elif isinstance(model, PredictsContact):
        contacts = ContactReadout(dataset, model, progress)
        answers, problems = _collect(contacts.answers, rounds, progress), contacts.problems
    else:
        answers, problems = _read_out(dataset, model, folder, readouts, config, rounds, progress)
    if not any(part.trials for part in answers):
        reason = next(iter(problems.values()), "no trial was asked")
        raise BadInputError(f"{provenance.model} predicts no trial: {reason}")
    table = make_table(answers, provenance, dataset.index)
    if not problems:
        write_table(table, path)
        return Evaluation(read_table(path), path, {})
    # Under a name of its own, so that the missing trials are tried again by the next run.
    partial = path.with_suffix(".partial.csv")
    write_table(table, partial)
    return Evaluation(read_table(partial), partial, problems)


def _read_out(
    dataset: Dataset,
    model: Model,
    folder: Path,
    readouts: tuple[Readout, ...],
    config: EvaluationConfig,
    rounds: list[Round],
    progress: Progress | None,
) -> tuple[list[Answers], dict[str, str]]:
    try:
        from physion.readout.features import FeatureReadout, make_fabric
    except ModuleNotFoundError as error:
        raise MissingExtraError(f"model {model.provenance().model!r}", "models") from error
    fabric = make_fabric(config.accelerator, config.seed)
    reader = FeatureReadout(
        dataset, model, readouts, _training(config), config.readout, fabric, folder, progress
    )
    return _collect(reader.answers, rounds, progress), {}


def _collect(
    answers: Callable[[Round], list[Answers]], rounds: list[Round], progress: Progress | None
) -> list[Answers]:
    made: list[Answers] = []
    for done, round_ in enumerate(rounds, start=1):
        made += answers(round_)
        if progress is not None:
            progress("rounds", done, len(rounds))
    return made


def _training(config: EvaluationConfig) -> TrainingConfig:
    from physion.training.loop import TrainingConfig

    return TrainingConfig(config.steps, config.batch, config.learning_rate, config.seed)


def _readouts(model: Model, config: EvaluationConfig) -> tuple[Readout, ...]:
    """The protocols asked for, or all that the model can do; `BadInputError` for one it cannot."""
    if isinstance(model, PredictsContact):
        possible = {Readout.OBSERVED_SIMULATED}
    elif not isinstance(model, Encodes):
        possible = set()
    elif isinstance(model, Simulates):
        possible = set(Readout)
    else:
        possible = {Readout.OBSERVED, Readout.FULL}
    asked = [Readout.named(name) for name in config.readouts]
    impossible = [readout.value for readout in asked if readout not in possible]
    if impossible or not possible:
        raise BadInputError(
            f"{model.provenance().model} cannot be read out under {impossible or 'any protocol'}; "
            f"it can under {[readout.value for readout in Readout if readout in possible]}"
        )
    chosen = asked or [readout for readout in Readout if readout in possible]
    return tuple(readout for readout in Readout if readout in chosen)


def _digest(
    dataset: Dataset, model: Model, config: EvaluationConfig, readouts: tuple[Readout, ...]
) -> str:
    """Hash of trials, labels, model and config: everything that decides the table."""
    columns = ["trial", "scenario", "split", "contact", "digest", "movie_sha256"]
    columns += ["observed_movie_sha256", "recorded_contact"]
    settings = dataclasses.asdict(config)
    settings["readouts"] = [readout.value for readout in readouts]
    own = getattr(model, "config", None)
    described = dataclasses.asdict(own) if dataclasses.is_dataclass(own) else {}  # type: ignore[arg-type]
    words = [_VERSION, physion.__version__, settings, dataclasses.asdict(model.provenance())]
    sha = hashlib.sha256(json.dumps([*words, described], sort_keys=True, default=str).encode())
    if isinstance(model, Encodes):
        sha.update(model.encoder_digest().encode())
    sha.update(dataset.index[columns].to_csv(index=False).encode())
    return sha.hexdigest()
