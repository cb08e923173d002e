"""Trainings that an evaluation needs, done on their own: ``physion train``."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from physion.compute.tasks import Progress
from physion.core.errors import BadInputError, MissingExtraError
from physion.models.build import build_model
from physion.models.interface import Model, ask
from physion.readout.folds import READOUT, TESTING, TRAINING, plan_folds, select_scenario
from physion.training.loop import TrainingOverrides
from physion.training.protocols import Training, training_sets
from physion.trials.dataset import Dataset

if TYPE_CHECKING:
    from lightning_fabric import Fabric

    from physion.training.train import TrainedModel


@dataclass(frozen=True, kw_only=True)
class SharedTrainConfig:
    """Settings that all trainings of a plan have in common; `EvaluationConfig` has some too."""

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

    def open_devices(self, precision: str) -> Fabric:
        """Return the devices, opened for a precision; raise `BadInputError` if there are none."""
        from physion.training.devices import Devices, make_fabric

        return make_fabric(Devices(self.accelerator, self.devices, self.nodes), precision)


@dataclass(frozen=True)
class TrainConfig(SharedTrainConfig):
    """Settings of `train`; those that `EvaluationConfig` has too mean the same."""

    protocol: Literal["all", "all-but", "only"] = "all"
    """Scenarios that train the model: all, all but one, or only one."""
    scenario: str = ""
    """Scenario that all-but leaves out, or the one of only; default: one training for each."""
    seed: int = 0
    """Seed of folds and training."""


@dataclass(frozen=True)
class PlannedTraining:
    """Name of a set of trials, such as ``all`` or ``no_drop``, and the trials.

    ``fold`` counts the folds of a cross-validation from 0; -1 without one.
    """

    name: str
    trials: tuple[str, ...]
    fold: int = -1


class Trainer:
    """One model with its initial weights, which is trained on one set of trials after the other.

    Parameters
    ----------
    dataset
        Trials.
    model
        A torch ``Module`` with a loss.
    folder
        Output folder of `evaluate`; None keeps nothing.
    overrides
        Optimiser and schedule, where they are not to be those of the model.
    shared
        Devices and batches.
    open_devices
        Returns the devices for a precision; by default those of ``shared`` are opened.

    Raises
    ------
    BadInputError
        If the model cannot be trained, or the devices are not there.
    """

    def __init__(
        self,
        dataset: Dataset,
        model: Any,
        folder: Path | None,
        overrides: TrainingOverrides,
        shared: SharedTrainConfig,
        open_devices: Callable[[str], Fabric] | None = None,
    ) -> None:
        # Imported late: a plan that is done trains nothing and reads no trial.
        from physion.clips.clips import whole_source
        from physion.readout.features import FeatureStore

        try:
            from physion.training.train import check_trainable
        except ModuleNotFoundError as error:
            raise MissingExtraError("training", "models") from error
        check_trainable(model)
        self.model, self.settings = model, overrides.apply(ask(model, "training_settings"))
        opened = open_devices if open_devices is not None else shared.open_devices
        self.fabric = opened(self.settings.precision)
        self.source = whole_source(dataset, model.spec, rendered=shared.rendered)
        self._folder = folder
        features = folder / "features" if folder is not None else None
        self._store = FeatureStore(features, batch=shared.encoder_batch)
        self._initial = copy.deepcopy(model.state_dict())

    def train(
        self, plan: PlannedTraining, seed: int, progress: Progress | None = None
    ) -> TrainedModel:
        """Train from the initial weights, which the model has again afterwards."""
        from physion.training.train import train_model

        shown = progress if self.fabric.is_global_zero else None

        def features(trials: Sequence[str]) -> NDArray[np.float32]:
            return self._store.encoded(self.model, self.source, trials, "whole", shown).array()

        try:
            return train_model(
                self.model,
                self.source,
                plan.trials,
                seed=seed,
                name=plan.name,
                folder=self._folder / "training" if self._folder is not None else None,
                settings=self.settings,
                features=features,
                fabric=self.fabric,
                progress=shown,
            )
        finally:
            self.model.load_state_dict(self._initial)


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
    overrides = settings if settings is not None else TrainingOverrides()
    trainer = Trainer(dataset, built, Path(folder), overrides, config)
    return [trainer.train(plan, config.seed, progress) for plan in planned]


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
    if (index["split"] == TESTING).any():
        folds = plan_folds(index, protocol, config.folds, config.seed)
        planned = [PlannedTraining(f.training.name, f.train, f.number) for f in folds]
    else:
        planned = _without_testing(index, protocol)
    kept = select_scenario([plan.name for plan in planned], protocol, config.scenario)
    return [planned[position] for position in kept]


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
