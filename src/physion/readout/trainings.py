"""Trainings that an evaluation needs, done on their own: ``physion train``."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pandas as pd

from physion.compute.progress import Progress
from physion.errors import BadInputError, MissingExtraError, UnknownNameError
from physion.models.build import build_model
from physion.models.interface import Model
from physion.readout.features.feature_store import FeatureStore
from physion.readout.folds import READOUT, TESTING, TRAINING, plan_folds
from physion.training.overrides import TrainingOverrides
from physion.training.protocols import Training, training_sets
from physion.training.sources.open_source import whole_source
from physion.trials.dataset import Dataset

if TYPE_CHECKING:
    from physion.training.train import TrainedModel


@dataclass(frozen=True)
class TrainConfig:
    """Settings of ``physion train``; those that `EvaluationConfig` has too mean the same."""

    protocol: Literal["all", "all-but", "only"] = "all"
    """Scenarios that train the model: all, all but one, or only one."""
    scenario: str = ""
    """Scenario that all-but leaves out, or the one of only; default: one training for each."""
    seed: int = 0
    """Seed of folds and training."""
    folds: int = 5
    """Folds of the cross-validation of a dataset that has testing trials alone."""
    encoder_batch: int = 4
    """Clips that a network encodes at a time; lower it when memory runs out."""
    rendered: bool = False
    """Render the pictures from the stored motions instead of reading the movies."""
    accelerator: str = "auto"
    """Device, by Lightning's name: auto, cpu, cuda, ..."""
    devices: int = 1
    """Devices of each node, among which every batch is divided."""
    nodes: int = 1
    """Nodes; the same command is started on each, as Lightning describes."""


@dataclass(frozen=True)
class PlannedTraining:
    """Name of a set of trials, such as ``all`` or ``no_drop``, and the trials."""

    name: str
    trials: tuple[str, ...]


def train(
    dataset: Dataset,
    model: Model | str,
    folder: Path | str,
    *,
    options: Mapping[str, Any] | None = None,
    settings: TrainingOverrides | None = None,
    config: TrainConfig | None = None,
    progress: Progress | None = None,
) -> list[TrainedModel]:
    """Train a model without labels, as `evaluate` would, which then finds the result.

    Parameters
    ----------
    dataset
        Trials. The split training is used, or readout where there is none, but no trial with the
        physics of a testing trial.
    model
        Name of a model (``physion ls models``), ``FILE.py:Class``, or a model. It keeps its
        initial weights, so that `evaluate` finds the trainings, whose weights it loads.
    folder
        Output folder of `evaluate`; each training has a folder in ``training/``.
    options
        Fields of the config of a model that is given by its name.
    settings
        Optimiser and schedule, where they are not to be those of the model.
    config
        Scenarios, seed and devices.
    progress
        Called after every step.

    Returns
    -------
    list[TrainedModel]
        One for every set of trials. What was trained before is not trained again.

    Raises
    ------
    BadInputError
        If the model cannot be trained, or there is no trial to train on.
    """
    config = config if config is not None else TrainConfig()
    planned = plan_trainings(dataset.index, config)
    if not isinstance(model, str) and options:
        raise BadInputError("options are for a model that is given by its name; this one is built")
    built: Any = build_model(model, **dict(options or {})) if isinstance(model, str) else model
    try:
        from physion.training.devices import Devices, make_fabric
        from physion.training.train import check_trainable, train_model
    except ModuleNotFoundError as error:
        raise MissingExtraError("training", "models") from error
    check_trainable(built)
    chosen = (settings if settings is not None else TrainingOverrides()).apply(built.settings)
    devices = Devices(config.accelerator, config.devices, config.nodes)
    fabric = make_fabric(devices, chosen.precision)
    shown = progress if fabric.is_global_zero else None
    source = whole_source(dataset, built.spec, rendered=config.rendered)
    store = FeatureStore(Path(folder) / "features", batch=config.encoder_batch)
    initial = copy.deepcopy(built.state_dict())
    trained = []
    for plan in planned:
        built.load_state_dict(initial)
        trained.append(
            train_model(
                built,
                source,
                plan.trials,
                seed=config.seed,
                name=plan.name,
                folder=Path(folder) / "training",
                settings=chosen,
                features=lambda trials: store.encoded(
                    built, source, trials, "whole", shown
                ).array(),
                fabric=fabric,
                progress=shown,
            )
        )
    built.load_state_dict(initial)
    return trained


def plan_trainings(index: pd.DataFrame, config: TrainConfig) -> list[PlannedTraining]:
    """Return the trainings that an evaluation of the dataset needs under a protocol.

    Without testing trials these are the trainings on all trials of the split training, or readout
    where there is none.

    Raises
    ------
    UnknownNameError
        If the chosen scenario has no trials.
    BadInputError
        If a scenario is chosen for the protocol all, or there is nothing to train on.
    """
    protocol = Training.named(config.protocol)
    if config.scenario and protocol is Training.ALL:
        raise BadInputError("a scenario needs the protocol all-but or only")
    if (index["split"] == TESTING).any():
        folds = plan_folds(index, protocol, config.folds, config.seed)
        planned = [PlannedTraining(fold.training.name, fold.train) for fold in folds]
    else:
        planned = _without_testing(index, protocol)
    if config.scenario:
        prefix = "no_" if protocol is Training.ALL_BUT else ""
        known = sorted({plan.name.removeprefix(prefix) for plan in planned})
        planned = [plan for plan in planned if plan.name == prefix + config.scenario]
        if not planned:
            raise UnknownNameError("scenario of the dataset", config.scenario, known)
    return planned


def _without_testing(index: pd.DataFrame, protocol: Training) -> list[PlannedTraining]:
    pool = index[index["split"] == TRAINING]
    if len(pool) == 0:
        pool = index[index["split"] == READOUT]
    if len(pool) == 0:
        raise BadInputError(
            f"the dataset has no trial in the splits {TRAINING}, {READOUT} or {TESTING} to train on"
        )
    return [
        PlannedTraining(
            chosen.name,
            tuple(sorted(str(t) for t in pool["trial"][pool["scenario"].isin(chosen.trained)])),
        )
        for chosen in training_sets(protocol, sorted(set(pool["scenario"])))
    ]
