"""Answers of any model that predicts the contact itself, without a readout or a fit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from physion.errors import BadInputError
from physion.models.interface import PredictsContact
from physion.models.observed import cut_to_observed
from physion.readout.folds import Asked, Round
from physion.readout.protocols import Readout
from physion.readout.table import Answers
from physion.trials.dataset import Dataset


@dataclass
class ContactReadout:
    """Asks the model about every tested trial; it is given the motion cut to its observed part.

    A trial that cannot be asked is left out of the answers and named in ``problems``.
    """

    dataset: Dataset
    model: PredictsContact
    progress: Callable[[str, int, int], None] | None = None

    def __post_init__(self) -> None:
        self.problems: dict[str, str] = {}

    def answers(self, round_: Round) -> list[Answers]:
        """All predictions of a round."""
        return [self._answer(round_, asked) for asked in round_.asked]

    def _answer(self, round_: Round, asked: Asked) -> Answers:
        found: dict[str, float] = {}
        for done, trial in enumerate(asked.test, start=1):
            try:
                found[trial] = self._probability(trial)
            except BadInputError as error:
                self.problems[trial] = str(error)
            if self.progress is not None:
                self.progress("trials", done, len(asked.test))
        return Answers(
            scenario=asked.scenario,
            protocol=Readout.OBSERVED_SIMULATED,
            trials=tuple(found),
            probability=np.array(list(found.values()), np.float64),
            train_accuracy=float("nan"),
            fit_trials=0,
            fold=round_.fold,
        )

    def _probability(self, trial: str) -> float:
        opened = self.dataset.trial(trial)
        p = self.model.predict_contact(
            opened.scene, cut_to_observed(opened.scene, opened.trajectory)
        )
        if not 0 <= p <= 1:
            raise BadInputError(f"trial {trial!r}: the model answers {p}, no probability")
        return float(p)
