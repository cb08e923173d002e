"""Answers of a model that sees: its features, read out by logistic regression."""

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

from physion.models.interface import Learns, Model
from physion.readout.folds import Asked, Round
from physion.readout.logistic import ReadoutConfig, fit_readout
from physion.readout.protocols import Readout, flatten_time
from physion.readout.table import Answers
from physion.seeds import stable_hash
from physion.training.clips import FeatureStore, FullClips, Progress, observed_clips
from physion.training.dynamics import DynamicsReport, simulate_features, train_dynamics
from physion.training.loop import TrainingConfig
from physion.trials.dataset import Dataset

Floats = NDArray[np.float32]
_UNKNOWN = float("nan")


@dataclass
class FeatureReadout:
    """Trains the dynamics of each round, and reads the features of its trials out.

    Under *observed* and *observed+simulated* the readout gets features of the observed movies
    alone; whole movies are opened for *full*, and to train dynamics on trials that are not tested
    in that round.
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
            self._fresh = copy.deepcopy(self.model.state_dict())
        self._observed = observed_clips(self.dataset, self.model.spec)
        self._labels = dict(
            zip(self.dataset.index["trial"], self.dataset.index["contact"], strict=True)
        )

    def answers(self, round_: Round) -> list[Answers]:
        """All predictions of a round."""
        report = self._train(round_)
        rollouts = self._simulate(round_)
        return [
            self._read_out(round_, asked, protocol, rollouts, report)
            for asked in round_.asked
            for protocol in self.readouts
        ]

    def _train(self, round_: Round) -> DynamicsReport | None:
        model = self.model
        wanted = Readout.OBSERVED_SIMULATED in self.readouts
        if not (wanted and isinstance(model, nn.Module) and isinstance(model, Learns)):
            return None
        clips = FullClips(self.dataset, self.model.spec)
        features = self._store.features(clips, round_.train, self.progress)
        # Every round starts from the same weights, not from what another one learnt.
        model.load_state_dict(self._fresh)
        folder = self.folder / "training" if self.folder is not None else None
        return train_dynamics(
            self.model, features, self.training, self.fabric, folder=folder, progress=self.progress
        )

    def _simulate(self, round_: Round) -> dict[str, Floats]:
        if Readout.OBSERVED_SIMULATED not in self.readouts:
            return {}
        trials = list(dict.fromkeys(t for a in round_.asked for t in (*a.fit, *a.test)))
        context = self._store.features(self._observed, trials, self.progress)
        steps = self.model.spec.total - self.model.spec.context
        made = simulate_features(self.model, context, steps, self.fabric)
        return dict(zip(trials, made, strict=True))

    def _read_out(
        self,
        round_: Round,
        asked: Asked,
        protocol: Readout,
        rollouts: dict[str, Floats],
        report: DynamicsReport | None,
    ) -> Answers:
        trials = [*asked.fit, *asked.test]
        if protocol.sees_future:
            clips = FullClips(self.dataset, self.model.spec)
            given = flatten_time(self._store.features(clips, trials, self.progress))
        else:
            seen = self._store.features(self._observed, trials, self.progress)
            parts = [seen]
            if protocol is Readout.OBSERVED_SIMULATED:
                parts.append(np.stack([rollouts[trial] for trial in trials]))
            given = flatten_time(*parts)
        count = len(asked.fit)
        labels = np.array([bool(self._labels[trial]) for trial in asked.fit], bool)
        fitted = fit_readout(given[:count], labels, given[count:], self.readout)
        return Answers(
            scenario=asked.scenario,
            protocol=protocol,
            trials=asked.test,
            probability=fitted.probability,
            train_accuracy=fitted.train_accuracy,
            fit_trials=count,
            fold=round_.fold,
            training_set=round_.training.name if report else "",
            training_seed=str(self.training.seed) if report else "",
            c=fitted.c,
            cv_accuracy=fitted.cv_accuracy,
            validation_loss=report.validation if report else _UNKNOWN,
            copy_last_loss=report.copy_last if report else _UNKNOWN,
            note=fitted.note,
        )


def make_fabric(accelerator: str, seed: int) -> Fabric:
    """One device by Lightning's name (``auto``, ``cpu``, ``cuda``, ``mps``), seeded."""
    torch.manual_seed(stable_hash("fabric", seed) % 2**63)
    options: dict[str, Any] = {"accelerator": accelerator, "devices": 1}
    return Fabric(**options)
