"""Models and the single participants of one scenario as arrays over the same stimuli."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.people.answers import (
    ScenarioAnswers,
    difference_of_pairs,
    mean_over_people,
)
from physion.analysis.sample import Resampled, Sample
from physion.analysis.statistics.calibration import check_probabilities
from physion.analysis.statistics.kappa import (
    correctness,
    cross_kappa,
)
from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Models:
    """Predictions of models for the stimuli of one scenario, in the order of its answers.

    ``p_contact`` (m, s) in 0..1 and ``predicted`` (m, s) 1 or 0; NaN if a model does not predict
    the stimulus. Raises `BadInputError` for other values or for shapes that do not fit.
    """

    names: tuple[str, ...]
    p_contact: Array
    predicted: Array

    def __post_init__(self) -> None:
        if not self.p_contact.shape == self.predicted.shape:
            raise BadInputError("P(contact) and predicted outcomes differ in shape")
        if len(self.names) != len(self.p_contact) or len(set(self.names)) != len(self.names):
            raise BadInputError("each model needs one name of its own and one row")
        check_probabilities(self.p_contact, gaps=True)
        if not (np.isnan(self.predicted) | np.isin(self.predicted, (0, 1))).all():
            raise BadInputError("predicted outcomes must be 0, 1 or NaN")
        if (np.isnan(self.predicted) != np.isnan(self.p_contact)).any():
            raise BadInputError("a stimulus needs both P(contact) and a predicted outcome")


def models_of(
    rows: pd.DataFrame, answers: ScenarioAnswers, agents: Sequence[str] | None = None
) -> tuple[Models, pd.DataFrame]:
    """Return the models of a table, and a table of what has no counterpart.

    Parameters
    ----------
    rows
        Table with ``agent``, ``stimulus``, ``p_contact``, ``predicted``.
    answers
        Answers of people to the scenario, whose stimuli are used.
    agents
        Names of the models in the order to use, whether they occur in ``rows`` or not; None: those
        that occur.

    Returns
    -------
    The models, and the table ``agent``, ``reason``, ``stimuli``. Raises `BadInputError` if a model
    predicts a stimulus twice.
    """
    twice = rows[rows.duplicated(["agent", "stimulus"])]
    if len(twice):
        raise BadInputError(
            f"{twice['agent'].iloc[0]!r} answers {twice['stimulus'].iloc[0]!r} twice"
        )
    names = tuple(map(str, rows["agent"].unique() if agents is None else agents))
    grids = [
        rows.pivot(index="agent", columns="stimulus", values=column)
        .reindex(index=list(names), columns=list(answers.stimuli))
        .to_numpy(dtype=np.float64)
        for column in ("p_contact", "predicted")
    ]
    unseen = rows[~rows["stimulus"].isin(answers.stimuli)].groupby("agent", sort=False).size()
    unmatched = [(agent, "people did not see it", int(n)) for agent, n in unseen.items()]
    gaps = np.isnan(grids[0]).sum(axis=1)
    unmatched += [(name, "the model does not predict it", int(n))
             for name, n in zip(names, gaps, strict=True) if n]  # fmt: skip
    dropped = pd.DataFrame(unmatched, columns=["agent", "reason", "stimuli"])
    return Models(names, grids[0], grids[1]), dropped


def sample_of_models(
    models: Models,
    answers: ScenarioAnswers,
    stimuli: Array | None = None,
    people: Array | None = None,
    drawn: Resampled | None = None,
) -> Sample:
    """Return models and people with weights of stimuli (b, s) and of people (b, n).

    Weights that are None count everything once.
    """
    resamples = 1 if people is None else len(people)
    if stimuli is None:
        stimuli = np.ones((resamples, len(answers.stimuli)))
    p_yes, right = mean_over_people(answers.yes, people), mean_over_people(answers.correct, people)
    everybody = np.ones((len(stimuli), len(answers.sessions)))
    return Sample(
        p_contact=models.p_contact,
        predicted=models.predicted,
        label=answers.label,
        shown=answers.label,
        p_yes=np.atleast_2d(p_yes),
        human_accuracy=np.atleast_2d(right),
        differ=np.atleast_2d(difference_of_pairs(answers.yes, people)),
        stimuli=stimuli,
        answers=answers,
        people=everybody if people is None else people,
        drawn=drawn,
    )


def model_pairs(models: Models, answers: ScenarioAnswers) -> pd.DataFrame:
    """Return kappa and error consistency of every two models.

    Columns: ``first``, ``second``, ``stimuli``, ``kappa``, ``error_consistency``; NaN if undefined.
    """
    right = correctness(models.predicted, answers.label)
    kappa, errors = (cross_kappa(a, a) for a in (models.predicted, right))
    has = (~np.isnan(models.predicted)).astype(np.float64)
    rows = [
        (models.names[i], models.names[j], int((has @ has.T)[i, j]), kappa[i, j], errors[i, j])
        for i, j in zip(*np.triu_indices(len(models.names), 1), strict=True)
    ]
    return pd.DataFrame(rows, columns=["first", "second", "stimuli", "kappa", "error_consistency"])
