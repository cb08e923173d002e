"""Predictions of a model that encodes frames: logistic regression on its features."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lightning_fabric import Fabric
from numpy.typing import NDArray
from torch import nn

from physion.compute.progress import Progress
from physion.models.interface import Learns, Model
from physion.readout.folds import Fold, ScenarioSplit
from physion.readout.logistic import ReadoutConfig, fit_readout
from physion.readout.protocols import Readout, flatten_time
from physion.readout.table import ScenarioPredictions, describe_labels
from physion.seeds import stable_hash
from physion.training.clips import FeatureStore, FullClips, observed_clips
from physion.training.dynamics import DynamicsReport, simulate_features, train_dynamics
from physion.training.loop import TrainingConfig
from physion.trials.dataset import Dataset

Floats = NDArray[np.float32]
_UNKNOWN = float("nan")


@dataclass
class FeatureReadout:
    """Predictor that trains the dynamics of each fold and fits readouts on the features.

    The protocols *observed* and *observed+simulated* read the observed movies alone. Whole movies
    are opened for *full*, and to train the dynamics on trials that the fold does not test.
    """

    dataset: Dataset
    model: Model
    readouts: Sequence[Readout]
    training: TrainingConfig
    readout: ReadoutConfig
    fabric: Fabric
    folder: Path | None
    progress: Progress | None = None

    def __post_init__(self) -> None:
        features = self.folder / "features" if self.folder is not None else None
        self._store = FeatureStore(self.model, features, self.fabric)
        if isinstance(self.model, nn.Module):
            self.fabric.to_device(self.model)
            self._initial_state = copy.deepcopy(self.model.state_dict())
        self._observed = observed_clips(self.dataset, self.model.spec)
        self._labels = dict(
            zip(self.dataset.index["trial"], self.dataset.index["contact"], strict=True)
        )

    def predict(self, fold: Fold) -> list[ScenarioPredictions]:
        """Return the predictions of a fold, one entry per scenario and protocol."""
        report = self._train(fold)
        rollouts = self._simulate(fold)
        return [
            self._predict_scenario(fold, split, protocol, rollouts, report)
            for split in fold.scenarios
            for protocol in self.readouts
        ]

    def _train(self, fold: Fold) -> DynamicsReport | None:
        model = self.model
        wanted = Readout.OBSERVED_SIMULATED in self.readouts
        if not (wanted and isinstance(model, nn.Module) and isinstance(model, Learns)):
            return None
        clips = FullClips(self.dataset, self.model.spec)
        features = self._store.features(clips, fold.train, self.progress)
        # Every fold starts from the same initial weights.
        model.load_state_dict(self._initial_state)
        folder = self.folder / "training" if self.folder is not None else None
        return train_dynamics(
            self.model, features, self.training, self.fabric, folder=folder, progress=self.progress
        )

    def _simulate(self, fold: Fold) -> dict[str, Floats]:
        if Readout.OBSERVED_SIMULATED not in self.readouts:
            return {}
        trials = list(dict.fromkeys(t for s in fold.scenarios for t in (*s.fit, *s.test)))
        context = self._store.features(self._observed, trials, self.progress)
        steps = self.model.spec.total - self.model.spec.context
        simulated = simulate_features(self.model, context, steps, self.fabric)
        return dict(zip(trials, simulated, strict=True))

    def _predict_scenario(
        self,
        fold: Fold,
        split: ScenarioSplit,
        protocol: Readout,
        rollouts: dict[str, Floats],
        report: DynamicsReport | None,
    ) -> ScenarioPredictions:
        trials = [*split.fit, *split.test]
        if protocol.sees_future:
            clips = FullClips(self.dataset, self.model.spec)
            inputs = flatten_time(self._store.features(clips, trials, self.progress))
        else:
            parts = [self._store.features(self._observed, trials, self.progress)]
            if protocol is Readout.OBSERVED_SIMULATED:
                parts.append(np.stack([rollouts[trial] for trial in trials]))
            inputs = flatten_time(*parts)
        count = len(split.fit)
        labels = np.array([bool(self._labels[trial]) for trial in split.fit], bool)
        fitted = fit_readout(inputs[:count], labels, inputs[count:], self.readout)
        return ScenarioPredictions(
            scenario=split.scenario,
            protocol=protocol,
            trials=split.test,
            probability=fitted.probability,
            train_accuracy=fitted.train_accuracy,
            fit_trials=count,
            fold=fold.number,
            fit_labels=describe_labels([False] * count),
            training_set=fold.training.name if report else "",
            training_seed=str(self.training.seed) if report else "",
            c=fitted.c,
            cv_accuracy=fitted.cv_accuracy,
            validation_loss=report.validation if report else _UNKNOWN,
            copy_last_loss=report.copy_last if report else _UNKNOWN,
            note=fitted.note,
        )


def make_fabric(accelerator: str, seed: int) -> Fabric:
    """Return a seeded Fabric on one device; ``accelerator`` is Lightning's name."""
    torch.manual_seed(stable_hash("fabric", seed) % 2**63)
    options: dict[str, Any] = {"accelerator": accelerator, "devices": 1}
    return Fabric(**options)
