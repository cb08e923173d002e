"""Models compared with single participants of one scenario: every measure and its intervals.

A *measure* of a model compares it with the people of the scenario; the *zone* of a measure is the
range of single people (or pairs, or halves of them) from the 2.5th to the 97.5th percentile.
Intervals draw people, stimuli, or both; they answer different questions, so each is named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.metrics import measure_metrics
from physion.analysis.people.answers import (
    ScenarioAnswers,
    difference_of_pairs,
    mean_over_people,
)
from physion.analysis.people.people import draws_of_people
from physion.analysis.sample import RESAMPLED, Resampled, Sample
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.statistics.calibration import check_probabilities
from physion.analysis.statistics.kappa import (
    correctness,
    cross_kappa,
)
from physion.errors import BadInputError

Array = npt.NDArray[np.float64]

TABLE_COLUMNS = (
    *("model", "scenario", "measure", "stimuli", "value"),
    *(f"{end}_{what}" for what in RESAMPLED for end in ("low", "high")),
    *("pair_low", "pair_median", "pair_high", "undefined", "reason"),
)


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


# --- the measures -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Measured:
    """Measures of models in one scenario, with the resamples for their intervals.

    ``values[measure]`` (m,); ``pairs[measure]`` (people, m), for measures with a value for each
    participant; ``draws[what][measure]`` (resamples, m) for each of `sample.RESAMPLED`, absent if
    the measure does not depend on the draw.
    """

    models: Models
    answers: ScenarioAnswers
    values: dict[str, Array]
    pairs: dict[str, Array]
    draws: dict[Resampled, dict[str, Array]]


def measure_models(models: Models, answers: ScenarioAnswers, bootstrap: Bootstrap) -> Measured:
    """Compute every measure of every model, and its resamples."""
    sample = sample_of_models(models, answers)
    values, pairs = {}, {}
    for metric in measure_metrics():
        values[metric.name] = metric(sample)[0]
        if metric.by_participant is not None:
            pairs[metric.name] = metric.by_participant(sample)
    draws: dict[Resampled, dict[str, Array]] = {
        what: {m.name: m(resamples) for m in measure_metrics() if what in m.resampled}
        for what, resamples in _samples(models, answers, bootstrap).items()
    }
    return Measured(models, answers, values, pairs, draws)


def measure_table(measured: Measured, bootstrap: Bootstrap) -> pd.DataFrame:
    """Return one row a model and measure.

    Columns: ``model``, ``scenario``, ``measure``, ``stimuli``, ``value``; ``low`` and ``high`` with
    ``_people``, ``_stimuli``, ``_both`` (interval by what is drawn); for measures by participant
    also ``pair_low``, ``pair_median``, ``pair_high`` (percentiles over participants) and
    ``undefined`` (participants for whom it is NaN); ``reason``.
    """
    models, records = measured.models, []
    for k, name in enumerate(models.names):
        for measure in measured.values:
            value = float(measured.values[measure][k])
            draws = {what: measured.draws[what].get(measure) for what in RESAMPLED}
            of_model = {
                what: None if drawn is None else drawn[:, k] for what, drawn in draws.items()
            }
            record, reasons = interval_columns(value, of_model, bootstrap)
            if not np.isfinite(value):
                reasons.insert(0, _why(measure, k, models, measured.answers))
            if measure in measured.pairs:
                record |= _over_people(measured.pairs[measure][:, k])
            records.append(
                {
                    "model": name,
                    "scenario": measured.answers.scenario,
                    "measure": measure,
                    "stimuli": int(np.sum(~np.isnan(models.p_contact[k]))),
                    **record,
                    "reason": "; ".join(reasons),
                }
            )
    return pd.DataFrame(records).reindex(columns=list(TABLE_COLUMNS))


def interval_columns(
    value: float, draws: Mapping[Resampled, Array | None], bootstrap: Bootstrap
) -> tuple[dict[str, Any], list[str]]:
    """Return ``value`` with ``low_`` and ``high_`` by what is drawn, and reasons for what is
    NaN.
    """
    record: dict[str, Any] = {"value": value}
    reasons = []
    for what in RESAMPLED:
        low, high = np.nan, np.nan
        drawn = draws[what]
        if drawn is None:
            reasons.append(f"no interval over {what}: they do not enter")
        elif np.isfinite(value):
            low, high = bootstrap.interval(drawn)
            if np.isnan(low):
                reasons.append(f"no interval over {what}: undefined in most resamples")
        record |= {f"low_{what}": low, f"high_{what}": high}
    return record, reasons


def _samples(models: Models, answers: ScenarioAnswers, draws: Bootstrap) -> dict[Resampled, Sample]:
    """Return the resamples for the intervals, by what is drawn."""
    people = draws_of_people(answers, draws)
    stimuli = draws.weights(answers.scenario, len(answers.stimuli))
    return {
        "people": sample_of_models(models, answers, None, people, "people"),
        "stimuli": sample_of_models(models, answers, stimuli, None, "stimuli"),
        "both": sample_of_models(models, answers, stimuli, people, "both"),
    }


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


def _over_people(values: Array) -> dict[str, float]:
    known = values[np.isfinite(values)]
    low, median, high = np.percentile(known, [2.5, 50, 97.5]) if len(known) else [np.nan] * 3
    return {"pair_low": float(low), "pair_median": float(median), "pair_high": float(high),
            "undefined": len(values) - len(known)}  # fmt: skip


def _why(measure: str, k: int, models: Models, answers: ScenarioAnswers) -> str:
    known = ~np.isnan(models.p_contact[k])
    if not known.any():
        return "the model predicts none of the stimuli"
    if measure in ("r", "r_beyond_outcome"):
        if known.sum() < 3:
            return "r: fewer than 3 stimuli"
        who = "the model's P(contact)" if np.ptp(models.p_contact[k, known]) < 1e-6 else "people"
        return f"r: {who} constant"
    return f"{measure}: it and the people always give the same one answer"


# --- models among themselves --------------------------------------------------------------------


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
