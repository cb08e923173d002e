"""Models beside single people in one scenario: every measure, its human zone, its intervals.

A *measure* of a model compares it with the people of the scenario; the *zone* of a measure is what
single people (or pairs, or halves of them) reach, from the 2.5th to the 97.5th percentile.
Intervals draw people, stimuli, or both; each is named, since they answer different questions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.people.answers import Answers, share
from physion.analysis.people.people import draws_of_people
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.statistics.calibration import check_probabilities
from physion.analysis.statistics.correlation import correlate_resampled
from physion.analysis.statistics.kappa import (
    correctness,
    cross_kappa,
    pair_values,
    pairwise_kappa,
    resampled_kappa,
    resampled_mean_kappa,
)
from physion.errors import BadInputError

Array = npt.NDArray[np.float64]

MEASURES = ("accuracy", "difference", "r", "rmsd", "euclid_over_n", "kappa", "kappa_gap",
            "error_consistency")  # fmt: skip
"""- ``accuracy``: share of right answers;
- ``difference``: accuracy less the mean accuracy of people on the same stimuli;
- ``r``: Pearson's r of P(contact) with the share of people who say yes;
- ``rmsd``: root of the mean squared difference of the same two;
- ``euclid_over_n``: the "RMSE" of the released notebooks, rmsd / sqrt(stimuli);
- ``kappa``: Cohen's kappa with each participant, mean over them;
- ``kappa_gap``: kappa less the mean kappa of all pairs of participants: the preregistered yardstick
  of how like people a model answers, best near 0;
- ``error_consistency``: kappa of right and wrong with each participant, mean over them."""

RESAMPLED = ("people", "stimuli", "both")
"""What an interval draws with replacement."""

TABLE_COLUMNS = (
    *("model", "scenario", "measure", "stimuli", "value"),
    *(f"{end}_{what}" for what in RESAMPLED for end in ("low", "high")),
    *("pair_low", "pair_median", "pair_high", "undefined", "reason"),
)


@dataclass(frozen=True)
class Models:
    """What models say about the stimuli of one scenario, in the order of `Answers.stimuli`.

    ``p_contact`` (m, s) in 0..1 and ``predicted`` (m, s) 1 or 0; NaN where a model lacks the
    stimulus. Raises `BadInputError` for other values or for shapes that do not fit.
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
    rows: pd.DataFrame, answers: Answers, agents: Sequence[str] | None = None
) -> tuple[Models, pd.DataFrame]:
    """The models of a table with ``agent``, ``stimulus``, ``p_contact``, ``predicted``.

    ``agents``: which ones, in this order, be they in ``rows`` or not. Also a table of what finds no
    counterpart: ``agent``, ``reason``, ``stimuli``. A stimulus that a model answers twice raises
    `BadInputError`.
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
    lost = [(agent, "people did not see it", int(n)) for agent, n in unseen.items()]
    gaps = np.isnan(grids[0]).sum(axis=1)
    lost += [(name, "the model does not predict it", int(n))
             for name, n in zip(names, gaps, strict=True) if n]  # fmt: skip
    dropped = pd.DataFrame(lost, columns=["agent", "reason", "stimuli"])
    return Models(names, grids[0], grids[1]), dropped


# --- the measures -------------------------------------------------------------------------------


@dataclass(frozen=True)
class Measured:
    """The measures of models in one scenario with what their intervals are made of.

    ``values[measure]`` (m,); ``pairs[measure]`` (people, m), for kappa and error consistency;
    ``draws[what][measure]`` (resamples, m) for each of `RESAMPLED`, absent where nothing is drawn.
    """

    models: Models
    answers: Answers
    values: dict[str, Array]
    pairs: dict[str, Array]
    draws: dict[str, dict[str, Array]]


def measure_models(models: Models, answers: Answers, bootstrap: Bootstrap) -> Measured:
    """Every measure of every model, and its resamples."""
    values, pairs = _values(models, answers)
    draws = {what: _resampled(models, answers, bootstrap, what) for what in RESAMPLED}
    return Measured(models, answers, values, pairs, draws)


def compare_with_people(
    models: Models, answers: Answers, bootstrap: Bootstrap | None = None
) -> pd.DataFrame:
    """Every model's measures in one scenario, one row a model and measure; see `measure_table`.

    To call for models and people that one has as arrays; `people_comparison.compare_everywhere`
    does the same, and more, from tables of all scenarios.
    """
    draws = bootstrap or Bootstrap()
    return measure_table(measure_models(models, answers, draws), draws)


def measure_table(measured: Measured, bootstrap: Bootstrap) -> pd.DataFrame:
    """One row a model and measure.

    Columns: ``model``, ``scenario``, ``measure``, ``stimuli``, ``value``; ``low`` and ``high`` with
    ``_people``, ``_stimuli``, ``_both`` (interval by what is drawn); for kappa and error
    consistency also ``pair_low``, ``pair_median``, ``pair_high`` (over participants) and
    ``undefined`` (participants for whom it is NaN); ``reason``.
    """
    models, records = measured.models, []
    for k, name in enumerate(models.names):
        for measure in MEASURES:
            value = float(measured.values[measure][k])
            draws = {what: measured.draws[what].get(measure) for what in RESAMPLED}
            own = {what: None if drawn is None else drawn[:, k] for what, drawn in draws.items()}
            record, reasons = interval_columns(value, own, bootstrap)
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
    value: float, draws: Mapping[str, Array | None], bootstrap: Bootstrap
) -> tuple[dict[str, Any], list[str]]:
    """``value`` with ``low_`` and ``high_`` of each of `RESAMPLED`, and reasons for what is NaN."""
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


def _values(models: Models, answers: Answers) -> tuple[dict[str, Array], dict[str, Array]]:
    """The value of each measure by model, and the (people, models) matrices behind two of them."""
    everybody = np.ones((1, len(answers.sessions)))
    everything = np.ones((1, len(answers.stimuli)))
    found = _by_sums(models, answers, everything, share(answers.yes)[None], everybody)
    pairs = {
        "kappa": cross_kappa(answers.yes, models.predicted),
        "error_consistency": cross_kappa(
            answers.correct, correctness(models.predicted, answers.label)
        ),
    }
    values = {name: rows[0] for name, rows in found.items()}
    for name, matrix in pairs.items():
        values[name] = share(matrix)
    among = pair_values(pairwise_kappa(answers.yes))
    known = among[np.isfinite(among)]
    values["kappa_gap"] = values["kappa"] - (np.mean(known) if len(known) else np.nan)
    return values, pairs


def _resampled(models: Models, answers: Answers, draws: Bootstrap, what: str) -> dict[str, Array]:
    """Each measure in each resample, (resamples, m); without what does not depend on the draw."""
    b, n, s = draws.resamples, len(answers.sessions), len(answers.stimuli)
    people = draws_of_people(answers, draws) if what != "stimuli" else np.ones((b, n))
    stimuli = draws.weights(answers.scenario, s) if what != "people" else np.ones((b, s))
    found = _by_sums(models, answers, stimuli, share(answers.yes, people), people)
    right = correctness(models.predicted, answers.label)
    drawn = None if what == "people" else stimuli
    found["kappa"] = _drawn_kappa(answers.yes, models.predicted, drawn, people)
    found["error_consistency"] = _drawn_kappa(answers.correct, right, drawn, people)
    among = resampled_mean_kappa(answers.yes, drawn, people)
    found["kappa_gap"] = found["kappa"] - among[:, None]
    if what == "people":
        del found["accuracy"]
    return found


def _drawn_kappa(theirs: Array, own: Array, stimuli: Array | None, people: Array) -> Array:
    """Mean kappa over the people drawn, (resamples, m)."""
    if stimuli is None:
        return share(cross_kappa(theirs, own), people)
    means = []
    for model in own:
        kappa = resampled_kappa(theirs, model, stimuli)
        known = np.isfinite(kappa)
        total = np.sum(np.where(known, kappa, 0.0) * people, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            means.append(total / np.sum(known * people, axis=1))
    return np.stack(means, axis=1)


def _by_sums(
    models: Models, answers: Answers, stimuli: Array, shares: Array, people: Array
) -> dict[str, Array]:
    """The measures that are functions of weighted sums over stimuli, (resamples, m).

    ``stimuli`` (resamples, s) and ``people`` (resamples, n) count the draws, ``shares``
    (resamples, s) is the share of yes among the people drawn.
    """
    has = (~np.isnan(models.p_contact)).astype(np.float64)
    right = np.nan_to_num(correctness(models.predicted, answers.label))
    x = np.nan_to_num(models.p_contact)
    seen = np.isfinite(shares)
    weights, y = np.where(seen, stimuli, 0.0), np.where(seen, shares, 0.0)
    human = np.where(seen, share(answers.correct, people), 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        n = weights @ has.T
        accuracy = (stimuli @ right.T) / (stimuli @ has.T)
        of_people = ((weights * human) @ has.T) / n
        own = (weights @ right.T) / n
        # (x - y)^2 with both around 0.5, so that little is lost in the subtractions.
        a, c = np.where(has > 0, x - 0.5, 0.0), y - 0.5
        square = weights @ (a * a).T - 2 * (weights * c) @ a.T + (weights * c * c) @ has.T
        distance = np.sqrt(np.maximum(square, 0.0) / n)
    return {
        "accuracy": accuracy,
        "difference": own - of_people,
        "r": correlate_resampled(models.p_contact, shares, stimuli),
        "rmsd": distance,
        "euclid_over_n": distance / np.sqrt(n),
    }


def _over_people(values: Array) -> dict[str, float]:
    known = values[np.isfinite(values)]
    low, median, high = np.percentile(known, [2.5, 50, 97.5]) if len(known) else [np.nan] * 3
    return {"pair_low": float(low), "pair_median": float(median), "pair_high": float(high),
            "undefined": len(values) - len(known)}  # fmt: skip


def _why(measure: str, k: int, models: Models, answers: Answers) -> str:
    known = ~np.isnan(models.p_contact[k])
    if not known.any():
        return "the model predicts none of the stimuli"
    if measure == "r":
        if known.sum() < 3:
            return "r: fewer than 3 stimuli"
        who = "the model's P(contact)" if np.ptp(models.p_contact[k, known]) < 1e-6 else "people"
        return f"r: {who} constant"
    return f"{measure}: it and the people always give the same one answer"


# --- models among themselves --------------------------------------------------------------------


def model_pairs(models: Models, answers: Answers) -> pd.DataFrame:
    """Kappa and error consistency of every two models: ``first``, ``second``, ``stimuli``,
    ``kappa``, ``error_consistency``, NaN where undefined."""
    right = correctness(models.predicted, answers.label)
    kappa, errors = (cross_kappa(a, a) for a in (models.predicted, right))
    has = (~np.isnan(models.predicted)).astype(np.float64)
    rows = [
        (models.names[i], models.names[j], int((has @ has.T)[i, j]), kappa[i, j], errors[i, j])
        for i, j in zip(*np.triu_indices(len(models.names), 1), strict=True)
    ]
    return pd.DataFrame(rows, columns=["first", "second", "stimuli", "kappa", "error_consistency"])
