"""Accuracy of people and agreement among them: by stimulus, by participant, by scenario.

All functions take the test rows of `Responses` (``responses.test``) after exclusions.
Intervals draw participants with replacement (`Bootstrap`, 1000 draws, seeded), as preregistered; a
*zone* is the middle 95 % of single participants or pairs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from physion.analysis.intervals import Bootstrap, distribution
from physion.analysis.statistics.agreement import (
    correlate_rows,
    pair_values,
    pairwise_correlation,
    pairwise_kappa,
    resampled_mean_of_pairs,
)
from physion.analysis.tables import MEAN, in_order
from physion.core.errors import BadInputError
from physion.core.seeds import generator

# Answers of one scenario as arrays of participants by stimuli.

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ScenarioAnswers:
    """Answers of all participants to one scenario.

    - ``sessions`` and ``participants``: names, length n, in the order of the rows of ``yes``;
    - ``stimuli``: names, length s, sorted: the columns;
    - ``yes`` (n, s): 1, 0, or NaN if that person did not answer;
    - ``label`` (s,): 1 if agent and patient touch, else 0;
    - ``log_rt`` (n, s): natural logarithm of the response time in ms, NaN if unknown.
    """

    scenario: str
    sessions: tuple[str, ...]
    participants: tuple[str, ...]
    stimuli: tuple[str, ...]
    yes: Array
    label: Array
    log_rt: Array

    @property
    def correct(self) -> Array:
        """Correctness of the answers (n, s): 1 right, 0 wrong, NaN without an answer."""
        return np.where(np.isnan(self.yes), np.nan, self.yes == self.label)

    def p_yes(self) -> Array:
        """Return the fraction of people who say yes, by stimulus, (s,)."""
        return mean_over_people(self.yes)


def mean_over_people(values: Array, weights: npt.ArrayLike | None = None) -> Array:
    """Return the mean over people, by stimulus, of values (n, s) with gaps; NaN if nobody answered.

    With ``weights`` (resamples, n), how often each person is drawn, the shape is (resamples, s).
    """
    given = ~np.isnan(values)
    drawn = np.ones(len(values)) if weights is None else np.asarray(weights, dtype=np.float64)
    total, count = drawn @ np.where(given, values, 0.0), drawn @ given.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(count > 0, total / count, np.nan)


def difference_of_pairs(yes: Array, weights: npt.ArrayLike | None = None) -> Array:
    """Return the fraction of pairs of different people who answer a stimulus differently.

    ``yes`` (n, s) holds 1, 0 or NaN; shape (s,), or (resamples, s) with ``weights`` (resamples, n),
    how often each person is drawn. A person who is drawn twice makes no pair with themselves. NaN
    where fewer than two people answered.
    """
    said_yes, said_no = (yes == 1).astype(np.float64), (yes == 0).astype(np.float64)
    drawn = np.ones(len(yes)) if weights is None else np.asarray(weights, dtype=np.float64)
    first, second = drawn @ said_yes, drawn @ said_no
    pairs = (first + second) ** 2 - drawn**2 @ (said_yes + said_no)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(pairs > 0, 2 * first * second / pairs, np.nan)


def answers_of(test: pd.DataFrame, scenario: str) -> ScenarioAnswers:
    """Return the answers to one scenario from the test rows of `Responses`.

    Raises `BadInputError` if the scenario has no answer, or a session two answers to one stimulus.
    """
    rows = test[test["scenario"] == scenario]
    if rows.empty:
        raise BadInputError(f"scenario {scenario!r} has no answer of people")
    person, people = pd.factorize(rows["session"], sort=True)
    column, stimuli = pd.factorize(rows["stimulus"], sort=True)
    shape = (len(people), len(stimuli))
    cells = person * shape[1] + column
    if len(np.unique(cells)) < len(cells):
        raise BadInputError(f"scenario {scenario!r}: a session answered one stimulus twice")

    def grid(values: npt.ArrayLike) -> Array:
        values_by_cell = np.full(shape[0] * shape[1], np.nan)
        values_by_cell[cells] = np.asarray(values, dtype=np.float64)
        return values_by_cell.reshape(shape)

    owner = rows.drop_duplicates("session").set_index("session")["participant"]
    label = rows.drop_duplicates("stimulus").set_index("stimulus")["label"]
    return ScenarioAnswers(
        scenario,
        tuple(map(str, people)),
        tuple(map(str, owner.loc[people])),
        tuple(map(str, stimuli)),
        grid(rows["yes"]),
        label.loc[stimuli].to_numpy(dtype=np.float64),
        grid(rows["log_rt"]),
    )


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
    """Return one row per stimulus.

    Columns: ``scenario``, ``stimulus``, ``label``, ``count`` (people), ``accuracy`` with ``_low``,
    ``_high``, ``p_yes``, ``consistency`` (fraction of people who gave the more frequent answer,
    right or wrong: 0.5 to 1), ``mean_log_rt`` (mean over people of the natural logarithm of the
    ms). They include the columns of `with_labels`, so that the table can replace that
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
    """Return one row per session.

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
    """Return one row per scenario and, in row `MEAN`, their mean with equal weights.

    Columns: ``scenario``, ``people``, ``stimuli``, ``accuracy`` (mean over people of their
    accuracy) with ``_low``, ``_high`` (interval of that mean), ``sd`` over people, ``t``, ``df``,
    ``p`` (two-sided, of people's accuracies against 0.5), ``zone_low``, ``zone_high`` (2.5th and
    97.5th percentile of single people), ``consistency`` (mean over stimuli), ``reason``. In row
    `MEAN` the scenarios' people are drawn independently, also if they are the same persons
    (`pooling_warnings`), who are counted once.
    """
    draws = bootstrap or Bootstrap()
    records, resampled = [], []
    for answers in all_answers(test):
        by_person = np.nanmean(answers.correct, axis=1)
        resampled.append(draws_of_people(answers, draws) @ by_person / len(by_person))
        records.append(_scenario_record(answers, by_person, resampled[-1], draws))
    table = pd.DataFrame(records)
    low, high = draws.interval(np.mean(resampled, axis=0))
    mean: dict[str, Any] = {
        "scenario": MEAN, "people": test["participant"].nunique(),
        "stimuli": int(table["stimuli"].sum()), "accuracy": table["accuracy"].mean(),
        "accuracy_low": low, "accuracy_high": high,
        "consistency": table["consistency"].mean(),
        "reason": "zone, sd and t: people of different scenarios are not one sample",
    }  # fmt: skip
    return pd.concat([table, pd.DataFrame([mean])], ignore_index=True)


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
    reasons = ["only one person: no interval, no zone"] if n == 1 else []
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
    """Return how much people of one scenario agree, one row per scenario and measure.

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
    found = distribution(values)
    reasons = []
    if found["undefined"]:
        reasons.append(f"{found['undefined']} undefined (constant answers) and left out")
    if not len(values):
        reasons.append("one person makes no pair")
    return {"scenario": scenario, "measure": measure, **found, "reason": "; ".join(reasons)}


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


def spearman_brown(r: npt.ArrayLike) -> Array:
    """Return the expected r of groups twice as large: 2 r / (1 + r), by Spearman and Brown.

    A negative r has no meaning for two halves, but is not clipped; NaN for r of -1.
    """
    values = np.asarray(r, dtype=np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(values > -1, 2 * values / (1 + values), np.nan)


# Statistics of single stimuli as items of a test: difficulty, and whether they measure the same.
#
# References
# ----------
# J. C. Nunnally and I. H. Bernstein, *Psychometric theory*, third edition, 1994, chapter 8.

COLUMNS = ("scenario", "stimulus", "people", "difficulty", "item_rest", "reason")


def item_statistics(test: pd.DataFrame) -> pd.DataFrame:
    """Return one row per stimulus.

    ``test``: test rows of `Responses`. Columns: ``scenario``, ``stimulus``, ``people``
    (who answered it), ``difficulty`` (fraction who are right, as item analysis names it: large is
    easy), ``item_rest`` (item-rest correlation: r over people of being right at this stimulus with
    the fraction of right answers at the other stimuli of the scenario that they answered),
    ``reason``. An item-rest correlation near 0 or below says that people who do well otherwise do
    not do better at this stimulus; it is NaN if all answers are right or wrong.
    """
    parts = []
    for answers in all_answers(test):
        right = answers.correct
        given = np.isfinite(right)
        known = np.where(given, right, 0.0)
        others = given.sum(axis=1)[:, None] - given
        with np.errstate(divide="ignore", invalid="ignore"):
            rest = np.where(others > 0, (known.sum(axis=1)[:, None] - known) / others, np.nan)
        people = given.sum(axis=0)
        difficulty = known.sum(axis=0) / people
        item_rest = correlate_rows(right.T, np.where(given, rest, np.nan).T)
        parts.append(
            pd.DataFrame(
                {
                    "scenario": answers.scenario,
                    "stimulus": answers.stimuli,
                    "people": people,
                    "difficulty": difficulty,
                    "item_rest": item_rest,
                    "reason": [
                        _why(value, fraction, count)
                        for value, fraction, count in zip(
                            item_rest, difficulty, people, strict=True
                        )
                    ],
                }
            )
        )
    return pd.concat(parts, ignore_index=True)[list(COLUMNS)]


def _why(item_rest: float, difficulty: float, people: int) -> str:
    if np.isfinite(item_rest):
        return ""
    if difficulty in (0, 1):
        return (
            "item-rest correlation: all answers are right"
            if difficulty
            else ("item-rest correlation: all answers are wrong")
        )
    return f"item-rest correlation: {people} people, or all equally good elsewhere"
