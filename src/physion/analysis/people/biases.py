"""Biases and covariates of answers: response bias, side bias, practice, background."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from physion.analysis.people.answers import ScenarioAnswers, mean_over_people
from physion.analysis.people.people import accuracy_by_participant, all_answers, draws_of_people
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.statistics.clustered_logit import clustered_logit
from physion.analysis.tables.csv_table import require_columns
from physion.analysis.tables.stimuli import in_order

Array = npt.NDArray[np.float64]

BACKGROUND = ("condition", "age", "gender", "education", "difficulty", "technical_problems")
"""Columns of the sessions about the condition, the participant and problems."""


# --- yes or no ----------------------------------------------------------------------------------


def yes_bias(test: pd.DataFrame, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Test whether people say yes too often; one row a scenario.

    Columns: ``scenario``, ``people``, ``base_rate`` (fraction of stimuli with contact, weighted by
    answers), ``yes`` (fraction of yes), ``bias`` (yes - base_rate) with ``_low``, ``_high``,
    ``d_prime`` and ``criterion`` (means over people; below 0: bias towards yes) with intervals,
    ``reason``. Intervals draw people. Hit and false-alarm rates use the log-linear correction (half
    an answer added to each side), so that d' is finite for people who are always right.
    """
    draws = bootstrap or Bootstrap()
    records = []
    for answers in all_answers(test):
        weights = draws_of_people(answers, draws)
        given = ~np.isnan(answers.yes)
        own_base = np.array([answers.label[row].mean() for row in given])
        own_yes = np.nanmean(answers.yes, axis=1)
        d_prime, criterion, reason = _signal_detection(answers)
        record: dict[str, Any] = {
            "scenario": answers.scenario,
            "people": len(own_yes),
            "base_rate": float(np.mean(own_base)),
            "yes": float(np.mean(own_yes)),
        }
        values = {"bias": own_yes - own_base, "d_prime": d_prime, "criterion": criterion}
        for name, by_person in values.items():
            record |= _mean_with_interval(name, by_person, weights, draws)
        records.append({**record, "reason": reason})
    return pd.DataFrame(records)


def _signal_detection(answers: ScenarioAnswers) -> tuple[Array, Array, str]:
    """Return d' and criterion of each person; NaN if all stimuli seen have the same outcome."""
    given = ~np.isnan(answers.yes)
    touch = given & (answers.label == 1)
    miss = given & (answers.label == 0)
    yes = np.where(given, answers.yes, 0.0)
    hits, of_hits = np.sum(yes * touch, axis=1), touch.sum(axis=1)
    alarms, of_alarms = np.sum(yes * miss, axis=1), miss.sum(axis=1)
    z_hit = stats.norm.ppf((hits + 0.5) / (of_hits + 1))
    z_alarm = stats.norm.ppf((alarms + 0.5) / (of_alarms + 1))
    undefined = (of_hits == 0) | (of_alarms == 0)
    d_prime = np.where(undefined, np.nan, z_hit - z_alarm)
    criterion = np.where(undefined, np.nan, -(z_hit + z_alarm) / 2)
    reason = "d' and criterion: stimuli of one outcome alone" if undefined.any() else ""
    return d_prime, criterion, reason


def _mean_with_interval(
    name: str, by_person: Array, weights: Array, draws: Bootstrap
) -> dict[str, float]:
    known = np.isfinite(by_person)
    drawn = mean_over_people(by_person[:, None], weights)[:, 0]
    low, high = draws.interval(drawn) if known.sum() > 1 else (np.nan, np.nan)
    mean = float(np.mean(by_person[known])) if known.any() else np.nan
    return {name: mean, f"{name}_low": low, f"{name}_high": high}


# --- left or right ------------------------------------------------------------------------------


def side_bias(test: pd.DataFrame, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Test whether people press the left button too often; one row a scenario.

    A person keeps one order of buttons, so side and answer are confounded within people but not
    between people. Columns: ``scenario``, ``yes_left``, ``yes_right`` (people with either order),
    ``left`` (fraction of left presses, mean of the two groups, so that a bias towards yes cancels)
    with ``_low``, ``_high`` (people drawn within each group) and ``p`` (Welch's test of the
    fraction of yes in the two groups), ``unknown`` (people whose order is unknown), ``reason``.
    """
    draws = bootstrap or Bootstrap()
    records = []
    for scenario in in_order(test["scenario"]):
        rows = test[test["scenario"] == scenario]
        order = rows["buttons"] if "buttons" in rows else pd.Series("", index=rows.index)
        by_person = rows.assign(order=order).groupby("session")[["yes", "order"]].agg(
            {"yes": "mean", "order": "first"}
        )  # fmt: skip
        groups = {name: by_person.loc[by_person["order"] == name, "yes"].to_numpy(dtype=np.float64)
                  for name in ("yes-no", "no-yes")}  # fmt: skip
        record = {"scenario": scenario} | _side_record(groups, scenario, draws)
        known = len(groups["yes-no"]) + len(groups["no-yes"])
        records.append({**record, "unknown": len(by_person) - known})
    return pd.DataFrame(records)


def _side_record(groups: dict[str, Array], scenario: str, draws: Bootstrap) -> dict[str, Any]:
    first, second = groups["yes-no"], groups["no-yes"]
    record: dict[str, Any] = {"yes_left": len(first), "yes_right": len(second)}
    nothing = dict.fromkeys(("left", "left_low", "left_high", "p"), np.nan)
    if min(len(first), len(second)) < 2:
        return {**record, **nothing, "reason": "fewer than two people of one order of buttons"}
    # Left presses are the yes of one group and the no of the other.
    drawn = [
        draws.weights(f"{name} of {scenario}", len(by_person)) @ by_person / len(by_person)
        for name, by_person in groups.items()
    ]
    low, high = draws.interval((drawn[0] + 1 - drawn[1]) / 2)
    constant = np.std(first) == 0 and np.std(second) == 0
    p = np.nan if constant else float(stats.ttest_ind(first, second, equal_var=False).pvalue)
    left = float((np.mean(first) + 1 - np.mean(second)) / 2)
    return {**record, "left": left, "left_low": low, "left_high": high, "p": p,
            "reason": "p: nobody differs within the groups" if constant else ""}  # fmt: skip


# --- practice and people ------------------------------------------------------------------------


def learning(test: pd.DataFrame, level: float = 0.95) -> pd.DataFrame:
    """Test whether people improve over the test trials, without feedback; one row a scenario, then
    all.

    Logistic regression of correctness on the position in the order, in units of 100 trials, with
    standard errors clustered by participant (`clustered_logit`); for all scenarios together with an
    intercept for each. Columns: ``scenario``, ``b`` (log odds per 100 trials), ``se``, ``t``,
    ``df``, ``p``, ``low``, ``high``, ``rows``, ``clusters``, ``reason``, ``first_half`` and
    ``second_half`` (accuracy in either half of the trials). Orders are random, so stimuli need no
    adjustment.
    """
    table = test.assign(hundred=test["trial"].to_numpy(dtype=np.float64) / 100)
    parts = [(name, table[table["scenario"] == name]) for name in in_order(table["scenario"])]
    if len(parts) > 1:
        parts.append(("all", table))
    fits = []
    for name, rows in parts:
        fixed = "scenario" if name == "all" else None
        fit = clustered_logit(rows, "correct", ["hundred"], fixed=fixed, level=level)
        fit = fit[fit["term"] == "hundred"].drop(columns="term")
        late = rows["trial"] >= (rows["trial"].max() + 1) / 2
        fit.insert(0, "scenario", name)
        fits.append(
            fit.assign(
                first_half=float(rows.loc[~late, "correct"].mean()),
                second_half=float(rows.loc[late, "correct"].mean()),
            )
        )
    return pd.concat(fits, ignore_index=True)


def background(sessions: pd.DataFrame) -> pd.DataFrame:
    """Count the answers to the questionnaire: one row a question and answer.

    Columns: ``question``, ``answer`` (``(none)`` if not answered), ``sessions``, ``share``
    (fraction).
    """
    parts = []
    for column in _asked(sessions):
        values = sessions[column].astype(object)
        named = values.where(values.notna() & (values != ""), "(none)")
        counts = named.value_counts(sort=False)
        counts = counts.sort_index(key=lambda index: index.map(str))
        parts.append(
            pd.DataFrame(
                {
                    "question": column,
                    "answer": [str(value) for value in counts.index],
                    "sessions": counts.to_numpy(),
                    "share": counts.to_numpy() / max(len(sessions), 1),
                }
            )
        )
    columns = ["question", "answer", "sessions", "share"]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=columns)


def accuracy_by_background(test: pd.DataFrame, sessions: pd.DataFrame) -> pd.DataFrame:
    """Test whether accuracy depends on age, gender, education or reported difficulty.

    Accuracies are taken relative to the mean of their scenario, since scenarios differ. One row a
    question: ``question``, ``sessions``, ``test`` (``spearman`` for numbers, ``kruskal-wallis`` for
    groups of at least two sessions), ``statistic``, ``df``, ``p``, ``reason``. Exploratory: as many
    tests as questions, p not corrected.
    """
    require_columns(sessions, ["session"], "the table of sessions")
    by_person = accuracy_by_participant(test)
    by_person["relative"] = by_person["accuracy"] - by_person.groupby("scenario")[
        "accuracy"
    ].transform("mean")
    # A session of several scenarios counts once.
    by_person = by_person.groupby("session", as_index=False, sort=False)["relative"].mean()
    joined = by_person.merge(sessions.drop(columns=["participant", "scenario"], errors="ignore"),
                       on="session", how="left")  # fmt: skip
    return pd.DataFrame([_association(joined, column) for column in _asked(joined)])


def _asked(table: pd.DataFrame) -> list[str]:
    """Return the columns of `BACKGROUND` that a table has; no condition if all cells are empty."""
    known = "condition" in table and (table["condition"].fillna("") != "").any()
    return [name for name in BACKGROUND if name in table and (name != "condition" or known)]


def _association(joined: pd.DataFrame, column: str) -> dict[str, Any]:
    values = joined[column].astype(object)
    rows = joined[values.notna() & (values != "")]
    record: dict[str, Any] = {"question": column, "sessions": len(rows), "test": "", "df": np.nan}
    record |= {"statistic": np.nan, "p": np.nan, "reason": ""}
    if column in ("age", "difficulty"):
        record["test"] = "spearman"
        numbers = rows[column].astype(np.float64)
        if len(rows) < 3 or numbers.nunique() < 2 or rows["relative"].nunique() < 2:
            return {**record, "reason": "too few answers, or all alike"}
        test_result = stats.spearmanr(numbers, rows["relative"])
        return {**record, "statistic": float(test_result.statistic), "p": float(test_result.pvalue)}
    record["test"] = "kruskal-wallis"
    groups = [part["relative"] for _, part in rows.groupby(column) if len(part) >= 2]
    if len(groups) < 2 or rows["relative"].nunique() < 2:
        return {**record, "reason": "fewer than two groups of two, or all accuracies alike"}
    test_result = stats.kruskal(*groups)
    return {**record, "df": len(groups) - 1, "statistic": float(test_result.statistic),
            "p": float(test_result.pvalue)}  # fmt: skip
