"""Accuracy of people and agreement among them: by stimulus, by participant, by scenario.

All functions take the test rows of `participants.Responses` (``responses.test``) after exclusions.
Intervals draw participants with replacement (`Bootstrap`, 1000 draws, seeded), as preregistered; a
*zone* is the middle 95 % of single participants or pairs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from physion.analysis.people.answers import ScenarioAnswers, answers_of, mean_over_people
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.statistics.correlation import correlate_rows
from physion.analysis.statistics.kappa import (
    pair_values,
    pairwise_correlation,
    pairwise_kappa,
    resampled_mean_of_pairs,
)
from physion.analysis.tables.stimuli import MEAN, in_order
from physion.core.errors import BadInputError
from physion.core.seeds import generator

Array = npt.NDArray[np.float64]

HALVES = 1000


def all_answers(test: pd.DataFrame) -> list[ScenarioAnswers]:
    """Return the answers to every scenario that occurs, in the order of the paper."""
    if test.empty:
        raise BadInputError("there is no test answer of people; was every session left out?")
    return [answers_of(test, name) for name in in_order(test["scenario"])]


def draws_of_people(answers: ScenarioAnswers, bootstrap: Bootstrap) -> Array:
    """Return how often each person is drawn, (resamples, n): the same draws for every statistic."""
    return bootstrap.weights(f"people of {answers.scenario}", len(answers.sessions))


def accuracy_by_stimulus(test: pd.DataFrame, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return one row a stimulus.

    Columns: ``scenario``, ``stimulus``, ``label``, ``count`` (people), ``accuracy`` with ``_low``,
    ``_high``, ``p_yes``, ``consistency`` (fraction of people who gave the more frequent answer,
    right or wrong: 0.5 to 1), ``mean_log_rt`` (mean over people of the natural logarithm of the
    ms). They include the columns of `responses.with_labels`, so that the table can replace that
    one.
    """
    draws = bootstrap or Bootstrap()
    parts = []
    for answers in all_answers(test):
        p_yes, accuracy = answers.p_yes(), mean_over_people(answers.correct)
        drawn = mean_over_people(answers.correct, draws_of_people(answers, draws))
        bounds = [draws.interval(column) for column in drawn.T]
        table = pd.DataFrame({"scenario": answers.scenario, "stimulus": answers.stimuli})
        parts.append(
            table.assign(
                label=answers.label.astype(bool),
                count=np.sum(~np.isnan(answers.yes), axis=0),
                accuracy=accuracy,
                accuracy_low=[low for low, _ in bounds],
                accuracy_high=[high for _, high in bounds],
                p_yes=p_yes,
                consistency=np.maximum(p_yes, 1 - p_yes),
                mean_log_rt=mean_over_people(answers.log_rt),
            )
        )
    return pd.concat(parts, ignore_index=True)


def accuracy_by_participant(test: pd.DataFrame) -> pd.DataFrame:
    """Return one row a session.

    Columns: ``scenario``, ``session``, ``participant``, ``trials``, ``accuracy``, ``yes`` (fraction
    of yes), ``mean_log_rt``, ``median_rt_ms``.
    """
    groups = test.groupby(["scenario", "session", "participant"], sort=True)
    table = groups.agg(
        trials=("correct", "size"),
        accuracy=("correct", "mean"),
        yes=("yes", "mean"),
        mean_log_rt=("log_rt", "mean"),
        median_rt_ms=("rt_ms", "median"),
    ).reset_index()
    return table.sort_values(
        "scenario", key=lambda names: names.map(in_order(test["scenario"]).index), kind="stable"
    ).reset_index(drop=True)


def accuracy_by_scenario(test: pd.DataFrame, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return one row a scenario and, in row `MEAN`, their mean with equal weights.

    Columns: ``scenario``, ``people``, ``stimuli``, ``accuracy`` (mean over people of their
    accuracy) with ``_low``, ``_high`` (interval of that mean), ``sd`` over people, ``t``, ``df``,
    ``p`` (two-sided, of people's accuracies against 0.5), ``zone_low``, ``zone_high`` (2.5th and
    97.5th percentile of single people), ``consistency`` (mean over stimuli), ``reason``. In row
    `MEAN` the scenarios' people are drawn independently, unless sessions have several scenarios:
    then a session is drawn with all of them.
    """
    draws = bootstrap or Bootstrap()
    records, resampled, accuracies = [], [], []
    for answers in all_answers(test):
        by_person = np.nanmean(answers.correct, axis=1)
        accuracies.append(pd.Series(by_person, index=list(answers.sessions)))
        resampled.append(draws_of_people(answers, draws) @ by_person / len(by_person))
        records.append(_scenario_record(answers, by_person, resampled[-1], draws))
    table = pd.DataFrame(records)
    people = len(set().union(*(by_session.index for by_session in accuracies)))
    joint = people < table["people"].sum()
    of_mean = _means_of_sessions(accuracies, draws) if joint else np.mean(resampled, axis=0)
    low, high = draws.interval(of_mean)
    mean: dict[str, Any] = {
        "scenario": MEAN, "people": people,
        "stimuli": int(table["stimuli"].sum()), "accuracy": table["accuracy"].mean(),
        "accuracy_low": low, "accuracy_high": high,
        "consistency": table["consistency"].mean(),
        "reason": "zone, sd and t: of each scenario alone" if joint
        else "zone, sd and t: people of different scenarios are not one sample",
    }  # fmt: skip
    return pd.concat([table, pd.DataFrame([mean])], ignore_index=True)


def _means_of_sessions(accuracies: Sequence[pd.Series], draws: Bootstrap) -> Array:
    """Return the mean over scenarios in each draw of whole sessions, (resamples,).

    ``accuracies``: of each scenario, by session. With the weight w of session i in a draw, the mean
    of a scenario is ``sum(w_i a_i) / sum(w_i)`` over its sessions.
    """
    table = pd.concat(accuracies, axis=1).sort_index()
    values = table.to_numpy(dtype=np.float64)
    weights = draws.weights("people of all scenarios", len(values))
    means: Array = np.mean(mean_over_people(values, weights), axis=1)
    return means


def accuracy_by_condition(test: pd.DataFrame, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return the rows of `accuracy_by_scenario` for each between-subject condition.

    The first column is ``condition``. Empty for responses without conditions.
    """
    known = test["condition"].fillna("") if "condition" in test else pd.Series("", test.index)
    parts = []
    for condition in sorted(set(known) - {""}):
        rows = accuracy_by_scenario(test[known == condition], bootstrap)
        rows.insert(0, "condition", condition)
        parts.append(rows)
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=["condition"])


def _scenario_record(
    answers: ScenarioAnswers, by_person: Array, resampled: Array, draws: Bootstrap
) -> dict[str, Any]:
    n = len(by_person)
    low, high = draws.interval(resampled) if n > 1 else (np.nan, np.nan)
    sd = float(np.std(by_person, ddof=1)) if n > 1 else np.nan
    reasons = ["one person alone: no interval, no zone"] if n == 1 else []
    if sd == 0:
        reasons.append("all people have the same accuracy: t is undefined")
    t = (float(np.mean(by_person)) - 0.5) / (sd / np.sqrt(n)) if sd > 0 else np.nan
    zone = np.percentile(by_person, [2.5, 97.5]) if n > 1 else (np.nan, np.nan)
    p_yes = answers.p_yes()
    return {
        "scenario": answers.scenario,
        "people": n,
        "stimuli": len(answers.stimuli),
        "accuracy": float(np.mean(by_person)),
        "accuracy_low": low,
        "accuracy_high": high,
        "sd": sd,
        "t": t,
        "df": n - 1,
        "p": float(2 * stats.t.sf(abs(t), n - 1)) if n > 1 else np.nan,
        "zone_low": float(zone[0]),
        "zone_high": float(zone[1]),
        "consistency": float(np.mean(np.maximum(p_yes, 1 - p_yes))),
        "reason": "; ".join(reasons),
    }


# --- how alike people are -----------------------------------------------------------------------


def agreement_by_scenario(
    test: pd.DataFrame, bootstrap: Bootstrap | None = None, halves: int = HALVES
) -> pd.DataFrame:
    """Return how much people of one scenario agree, one row a scenario and measure.

    ``measure``: ``kappa`` and ``correlation`` of all pairs of participants, ``split_half`` (r of
    the fractions of yes of two random halves) and ``spearman_brown`` (the same, each r corrected to
    the full number of people). Columns: ``values`` (number of pairs or halves), ``undefined`` (NaN
    among them), ``mean``, ``mean_low``, ``mean_high`` (drawing participants; without pairs of a
    person with themselves; NaN for halves), ``low``, ``median``, ``high`` (2.5th, 50th and 97.5th
    percentile of the values), ``reason``.
    """
    draws = bootstrap or Bootstrap()
    records = []
    for answers in all_answers(test):
        people = draws_of_people(answers, draws)
        for name, matrix in (
            ("kappa", pairwise_kappa(answers.yes)),
            ("correlation", pairwise_correlation(answers.yes)),
        ):
            record = _spread(answers.scenario, name, pair_values(matrix))
            low, high = draws.interval(resampled_mean_of_pairs(matrix, people))
            records.append({**record, "mean_low": low, "mean_high": high})
        r = split_halves(answers.yes, halves, draws.seed)
        for name, values in (("split_half", r), ("spearman_brown", spearman_brown(r))):
            record = _spread(answers.scenario, name, values)
            records.append({**record, "mean_low": np.nan, "mean_high": np.nan})
    columns = ["scenario", "measure", "values", "undefined", "mean", "mean_low", "mean_high"]
    return pd.DataFrame(records)[[*columns, "low", "median", "high", "reason"]]


def _spread(scenario: str, measure: str, values: Array) -> dict[str, Any]:
    known = values[np.isfinite(values)]
    low, median, high = np.percentile(known, [2.5, 50, 97.5]) if len(known) else [np.nan] * 3
    reasons = []
    if len(known) < len(values):
        reasons.append(f"{len(values) - len(known)} undefined (constant answers) and left out")
    if not len(values):
        reasons.append("one person alone makes no pair")
    return {
        "scenario": scenario,
        "measure": measure,
        "values": len(values),
        "undefined": len(values) - len(known),
        "mean": float(np.mean(known)) if len(known) else np.nan,
        "low": float(low),
        "median": float(median),
        "high": float(high),
        "reason": "; ".join(reasons),
    }


def split_halves(yes: Array, halves: int = HALVES, seed: int = 0) -> Array:
    """Return r between the fractions of yes of two random halves of the people, (halves,).

    If the number of people is odd, the second half has one more. NaN if r is undefined; empty for
    fewer than two people.
    """
    n = len(yes)
    if n < 2:
        return np.empty(0)
    rng = generator("halves", seed, n)
    order = rng.permuted(np.tile(np.arange(n), (halves, 1)), axis=1)
    first = (order < n // 2).astype(np.float64)
    return correlate_rows(mean_over_people(yes, first), mean_over_people(yes, 1 - first))


def spearman_brown(r: npt.ArrayLike, factor: float = 2.0) -> Array:
    """Return the expected r of groups ``factor`` times as large, by Spearman and Brown.

    NaN for r of -1 / (factor - 1) or less. A negative r has no meaning for two halves, but is not
    clipped.
    """
    values = np.asarray(r, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        below = 1 + (factor - 1) * values
        return np.where(below > 0, factor * values / below, np.nan)
