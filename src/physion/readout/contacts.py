"""Predictions of models that return P(contact) themselves, without a readout or a fit."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from physion.compute.progress import Progress
from physion.errors import BadInputError
from physion.models.interface import PredictsContact
from physion.models.observed import cut_to_observed
from physion.readout.folds import Fold, ScenarioSplit
from physion.readout.protocols import Readout
from physion.readout.table import ScenarioPredictions
from physion.trials.dataset import Dataset


@dataclass
class ContactReadout:
    """Predictor that asks the model for P(contact) of every tested trial.

    The model receives the motion of the observed frames alone. Trials that fail have no
    prediction; ``problems`` maps their names to the reasons.
    """

    dataset: Dataset
    model: PredictsContact
    progress: Progress | None = None

    def __post_init__(self) -> None:
        self.problems: dict[str, str] = {}

    def predict(self, fold: Fold) -> list[ScenarioPredictions]:
        """Return the predictions of a fold, one entry per scenario."""
        return [self._predict_scenario(fold, split) for split in fold.scenarios]

    def _predict_scenario(self, fold: Fold, split: ScenarioSplit) -> ScenarioPredictions:
        predicted: dict[str, float] = {}
        for done, trial in enumerate(split.test, start=1):
            try:
                predicted[trial] = self._probability(trial)
            except BadInputError as error:
                self.problems[trial] = str(error)
            if self.progress is not None:
                self.progress("trials", done, len(split.test))
        return ScenarioPredictions(
            scenario=split.scenario,
            protocol=Readout.OBSERVED_SIMULATED,
            trials=tuple(predicted),
            probability=np.array(list(predicted.values()), np.float64),
            train_accuracy=float("nan"),
            fit_trials=0,
            fold=fold.number,
            fit_labels="",
        )

    def _probability(self, trial: str) -> float:
        opened = self.dataset.trial(trial)
        p = self.model.predict_contact(
            opened.scene, cut_to_observed(opened.scene, opened.trajectory)
        )
        if not 0 <= p <= 1:
            raise BadInputError(f"trial {trial!r}: the model returned {p}, not a probability")
        return float(p)
