"""Columns of the leaderboard, what a complete submission is, and the order of the rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from physion.analysis.leaderboard.rows import DETECTION, PEOPLE
from physion.analysis.metrics import leaderboard_metrics
from physion.analysis.models.comparison import NOT_PREDICTED
from physion.analysis.tables.stimuli import MEAN, POOLED
from physion.core.errors import UnknownNameError

FIRST_COLUMNS = (
    "rank",
    "rank_low",
    "rank_high",
    "first",
    "kind",
    "model",
    "readout",
    "training",
    "file",
    "scenarios",
    "of_scenarios",
    "stimuli",
    "of_stimuli",
)
NORMALISED = ("ceiling", "r_of_ceiling", "kappa_of_people", "floor")
LAST_COLUMNS = ("versions", "license", "sha256", "agent", "reason")


def columns() -> list[str]:
    """Return the columns of the table: each metric with ``_low`` and ``_high`` between the names.

    ``kind`` is model, detection (a model that sees the whole movie), people or anchor; only models
    have a ``rank``, equal scores the same one. ``rank_low``, ``rank_high`` and ``first`` are those
    of `ranks.rank_intervals`. ``ceiling`` is the noise ceiling of r and ``r_of_ceiling`` r divided
    by it; ``kappa_of_people`` is kappa from averages divided by that of one person with another;
    ``floor`` is the RMSD of a model that knows the true fractions of yes. ``scenarios`` and
    ``stimuli`` count what the scores rest on, out of ``of_scenarios`` and ``of_stimuli``: what
    people saw or, without people, what all files name. ``agent`` is the name by which the file's
    own rows are told apart; ``reason`` says what a score rests on where that is not everything, and
    why a score is NaN.
    """
    scores = [f"{one.name}{end}" for one in leaderboard_metrics() for end in ("", "_low", "_high")]
    return [*FIRST_COLUMNS, *scores, *NORMALISED, *LAST_COLUMNS]


def required_stimuli(answered: pd.DataFrame, dropped: pd.DataFrame) -> pd.Series:
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


def with_required(table: pd.DataFrame, required: pd.Series, scenario: str) -> pd.DataFrame:
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

    Models that see the whole movie, and then anchors, come after the models, in the same order and
    without a rank. By a metric, models that lack stimuli come after those that lack none, since
    means over other scenarios are not comparable, and equal scores have the same rank.
    ``ascending`` None puts the best first: large scores, small RMSD, text alphabetically. Raises
    `UnknownNameError` with the closest columns.
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
    groups = [order[order["kind"] == "model"], order[order["kind"] == DETECTION],
              order[~order["kind"].isin(("model", DETECTION))]]  # fmt: skip
    ranked = pd.concat([group for group in groups if len(group)], ignore_index=True)
    ranks = pd.Series(np.arange(1, len(order) + 1), dtype="Int64")
    if metric is not None:
        ranks = _with_ties(ranks, ranked[by], _is_partial(ranked))
    return ranked.assign(rank=ranks.where(ranks.index < len(groups[0])))


def _with_ties(ranks: pd.Series, scores: pd.Series, partial: pd.Series) -> pd.Series:
    """Return the ranks with the first of them for all rows of one score that follow each other."""
    same = (scores == scores.shift()) & (partial == partial.shift())
    return ranks.where(~same).ffill().astype("Int64")


def add_normalised(table: pd.DataFrame, anchors: pd.DataFrame) -> pd.DataFrame:
    """Return the table with ``kappa_of_people``, of models that predict what people saw."""
    if anchors.empty:
        return table.assign(kappa_of_people=np.nan)
    people = float(anchors.loc[anchors["kind"] == PEOPLE, "kappa_from_averages"].iloc[0])
    ratio = table["kappa_from_averages"] / people
    return table.assign(kappa_of_people=ratio.mask(_is_partial(table)))
