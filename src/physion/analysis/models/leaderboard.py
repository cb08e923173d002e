"""Leaderboard: one table of many prediction files with accuracy, similarity to people and versions.

Each file is compared separately, on the stimuli that people saw and it predicts, so that files made
on different sets of trials can be in one table; the column ``stimuli`` counts them. A file that
cannot be compared is listed in `Leaderboard.refused` with the reason. A model that lacks stimuli
ranks after those that lack none, whatever its scores.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from physion.analysis.metrics import leaderboard_metrics
from physion.analysis.models.comparison import NOT_PREDICTED, compare_scores
from physion.analysis.models.leaderboard_rows import read_submission, score_models
from physion.analysis.people.exclusions import (
    PREREGISTERED,
    ExclusionRules,
    flag_sessions,
    without_flagged,
)
from physion.analysis.people.participants import Responses, check_labels
from physion.analysis.people.people import all_answers
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.tables.stimuli import MEAN, POOLED
from physion.errors import BadInputError, UnknownNameError
from physion.stimulus_names import SCENARIOS

FIRST_COLUMNS = (
    "rank",
    "model",
    "readout",
    "training",
    "file",
    "scenarios",
    "of_scenarios",
    "stimuli",
    "of_stimuli",
)
LAST_COLUMNS = ("versions", "agent", "reason")


def columns() -> list[str]:
    """Return the columns of the table: each metric with ``_low`` and ``_high`` between the names.

        ``scenarios`` and ``stimuli`` count what the scores rest on, out of
    ``of_scenarios`` and ``of_stimuli``: what people saw or, without people, what all files name.
    ``agent`` is the name by which the file's own rows are told apart; ``reason`` says what a score
    rests on where that is not everything, and why a score is NaN.
    """
    scores = [f"{one.name}{end}" for one in leaderboard_metrics() for end in ("", "_low", "_high")]
    return [*FIRST_COLUMNS, *scores, *LAST_COLUMNS]


@dataclass(frozen=True)
class Leaderboard:
    """Ranked table of models.

    - ``table``: see `columns`.
    - ``dropped``: what was left out of each file: ``file``, ``agent``, ``scenario``, ``reason``,
      ``stimuli``.
    - ``refused``: files that could not be compared: ``file``, ``reason``.
    - ``dropped_answers``: excluded answers of people (`Responses.dropped`); None without single
      answers.
    - ``settings``: the settings as text, by name.
    """

    table: pd.DataFrame
    dropped: pd.DataFrame
    refused: pd.DataFrame
    dropped_answers: pd.DataFrame | None
    settings: Mapping[str, str]


def leaderboard(
    files: Sequence[Path],
    humans: pd.DataFrame | None = None,
    labels: Mapping[str, bool] | None = None,
    responses: Responses | None = None,
    *,
    rules: ExclusionRules = PREREGISTERED,
    expected: Mapping[str, int] | None = None,
    scenario: str = MEAN,
    exclude: Iterable[str] = (),
    exclude_ledge: bool = True,
    bootstrap: Bootstrap | None = None,
) -> Leaderboard:
    """Score every model of every file, best accuracy first; see `sort_leaderboard`.

    Parameters
    ----------
    files
        CSV files of predictions.
    humans, labels, exclude, exclude_ledge
        As in `comparison.compare`.
    responses
        Answers of single participants; the sessions that ``rules`` flag are left out. They give
        kappa and, if ``humans`` is None, replace it.
    rules, expected
        As in `exclusions.flag_sessions`.
    scenario
        One of the eight, *mean* (with equal weights) or *pooled*.
    bootstrap
        Draws for the intervals.

    Raises
    ------
    BadInputError
        If no file is given or none can be compared, no session is left, or the outcomes of the
        responses contradict ``labels``.
    """
    if not files:
        raise BadInputError("no file of predictions was given")
    if scenario not in (*SCENARIOS, MEAN, POOLED):
        raise UnknownNameError("scenario", scenario, (*SCENARIOS, MEAN, POOLED))
    draws = bootstrap or Bootstrap()
    unwanted = tuple(exclude)
    kept, flagging = _unflagged(responses, rules, expected, labels)
    test = None if kept is None else kept.test
    people, outcomes = _people(humans, labels, test)
    answers = {} if test is None else {each.scenario: each for each in all_answers(test)}
    tables, dropped, refused, answered = [], [], [], []
    settings: Mapping[str, str] = {}
    for path in files:
        try:
            rows, versions = read_submission(path)
            comparison = compare_scores(
                rows,
                people,
                outcomes,
                exclude=unwanted,
                exclude_ledge=exclude_ledge,
                bootstrap=draws,
            )
            scored = score_models(comparison, rows, answers, scenario, draws)
        except BadInputError as error:
            refused.append({"file": str(path), "reason": str(error)})
            continue
        tables.append(scored.assign(file=str(path), versions=scored["agent"].map(versions)))
        dropped.append(comparison.dropped.assign(file=str(path)))
        answered.append(
            comparison.stimuli[["agent", "scenario", "stimulus"]].assign(file=str(path))
        )
        settings = comparison.settings
    if not tables:
        raise BadInputError(f"no file can be compared: {refused[0]['reason']}")
    left_out = pd.concat(dropped, ignore_index=True)
    required = _required_stimuli(pd.concat(answered, ignore_index=True), left_out)
    table = _with_required(pd.concat(tables, ignore_index=True), required, scenario)
    order = ["file", "agent", "scenario", "reason", "stimuli"]
    return Leaderboard(
        sort_leaderboard(table.reindex(columns=columns())),
        left_out[order],
        pd.DataFrame(refused, columns=["file", "reason"]),
        None if kept is None else kept.dropped,
        {**settings, **_describe_scores(scenario, test is not None), **flagging},
    )


def _unflagged(
    responses: Responses | None,
    rules: ExclusionRules,
    expected: Mapping[str, int] | None,
    labels: Mapping[str, bool] | None,
) -> tuple[Responses | None, dict[str, str]]:
    """Return the responses without flagged sessions, and the rules as text."""
    if responses is None:
        return None, {}
    if labels is not None:
        check_labels(responses, labels)
    flags = flag_sessions(responses, rules, expected=expected)
    words = (
        f"{int(flags['flagged'].sum())} of {len(flags)} sessions flagged by the rules "
        f"“{rules.name}” and left out"
    )
    return without_flagged(responses, flags), {"Exclusions": words}


def _required_stimuli(answered: pd.DataFrame, dropped: pd.DataFrame) -> pd.Series:
    """Return the number of stimuli of a complete submission, by scenario.

    With people, what they saw: what a model predicted of it and what it lacks. Without people, what
    all files contain together.
    """
    keys = ["file", "agent", "scenario"]
    lacking = dropped[dropped["reason"] == NOT_PREDICTED].groupby(keys)["stimuli"].sum()
    seen = answered.groupby(keys)["stimulus"].nunique().add(lacking, fill_value=0)
    named = answered.groupby("scenario")["stimulus"].nunique()
    most = pd.concat([seen.groupby("scenario").max(), named], axis=1).max(axis=1)
    return most.astype(int)


def _with_required(table: pd.DataFrame, required: pd.Series, scenario: str) -> pd.DataFrame:
    """Add ``of_scenarios`` and ``of_stimuli``, and a reason if a model lacks some of them."""
    whole = required if scenario in (MEAN, POOLED) else required[[scenario]]
    table = table.assign(of_scenarios=len(whole), of_stimuli=int(whole.sum()))
    for index, row in table.iterrows():
        if not _is_partial(row):
            continue
        over = "mean over" if scenario == MEAN else "over"
        why = f"{over} {row['scenarios']} of {len(whole)} scenarios"
        if row["scenarios"] == len(whole):
            why = f"over {row['stimuli']} of {row['of_stimuli']} stimuli"
        table.loc[index, "reason"] = "; ".join(filter(None, [why, row["reason"]]))
    return table


def _is_partial(rows: Any) -> Any:
    """Return whether a row, or each row of a table, is about fewer stimuli than there are."""
    return rows["stimuli"] < rows["of_stimuli"]


def sort_leaderboard(
    table: pd.DataFrame, by: str = "accuracy", ascending: bool | None = None
) -> pd.DataFrame:
    """Sort the table by any column; ``rank`` follows that order, NaN last, ties by model and file.

    By a metric, models that lack stimuli come after those that lack none, since means over other
    scenarios are not comparable. ``ascending`` None puts the best first: large scores, small RMSD,
    text alphabetically. Raises `UnknownNameError` with the closest columns.
    """
    if by not in table.columns or by == "rank":
        raise UnknownNameError("column", by, [name for name in table.columns if name != "rank"])
    scores = {metric.name: metric for metric in leaderboard_metrics()}
    metric = scores.get(by.removesuffix("_low").removesuffix("_high"))
    if ascending is None:
        numeric = pd.api.types.is_numeric_dtype(table[by])
        ascending = not numeric or (metric is not None and metric.better == "lower")
    ties = [name for name in ("model", "readout", "training", "file", "agent") if name != by]
    order = table.sort_values(ties, kind="stable").sort_values(
        by, ascending=ascending, kind="stable", na_position="last"
    )
    if metric is not None:
        after = _is_partial(order).astype(int).mask(order[by].isna(), 2)
        order = order.loc[after.sort_values(kind="stable").index]
    return order.assign(rank=np.arange(1, len(order) + 1)).reset_index(drop=True)


def _people(
    humans: pd.DataFrame | None, labels: Mapping[str, bool] | None, test: pd.DataFrame | None
) -> tuple[pd.DataFrame | None, Mapping[str, bool] | None]:
    """Return people by stimulus and outcomes: those given, else those of the single answers."""
    if test is None:
        return humans, labels
    known = test.drop_duplicates("stimulus").set_index("stimulus")["label"]
    outcomes = {str(name): bool(value) for name, value in known.items()} | dict(labels or {})
    if humans is None:
        by = test.groupby(["stimulus", "scenario"], as_index=False, sort=False)
        humans = by.agg(accuracy=("correct", "mean"), count=("correct", "size"))
    return humans, outcomes


def _describe_scores(scenario: str, single: bool) -> dict[str, str]:
    descriptions = {
        "Leaderboard": "each file by itself, on the stimuli that it shares with people; scores of "
        + (scenario if scenario in SCENARIOS else f"the row “{scenario}” over scenarios")
    }
    if single:
        descriptions["Kappa"] = (
            "mean over participants of Cohen's kappa with the model, averaged over scenarios; its "
            "interval draws participants, those of the other scores draw stimuli"
        )
    return descriptions
