"""Rows of the leaderboard from one file: its models and their scores."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pandas as pd

from physion.analysis.metrics import Metric, leaderboard_metrics
from physion.analysis.models.anchors import (
    TWO_PEOPLE,
    anchor_scores,
    anchor_stimuli,
    seen_stimuli,
)
from physion.analysis.models.comparison import Comparison
from physion.analysis.models.model_people import models_of, sample_of_models
from physion.analysis.models.sampling_variance import sampling_variances
from physion.analysis.people.answers import ScenarioAnswers
from physion.analysis.statistics.jackknife import mean_of
from physion.analysis.tables.predictions import READOUTS
from physion.analysis.tables.stimuli import MEAN, POOLED
from physion.core.errors import BadInputError

DETECTION = "detection"
"""``kind`` of models that see the whole movie, so that they need not predict."""

PEOPLE = "people"
"""``kind`` of the row of one person with another."""


def score_models(
    comparison: Comparison,
    rows: pd.DataFrame,
    answers: Mapping[str, ScenarioAnswers],
    scenario: str,
    level: float,
) -> pd.DataFrame:
    """Return one row for each model of one file, whose checked rows are ``rows``.

    A model whose readout sees the whole movie has the kind `DETECTION`.
    """
    table = _scored(comparison.scores, comparison.stimuli, answers, scenario, level)
    sees_outcome = (table["readout"] == READOUTS["A"]) & (table["kind"] == "model")
    table["kind"] = table["kind"].mask(sees_outcome, DETECTION)
    training = rows.drop_duplicates("agent").set_index("agent")["Dynamics Training Dataset"]
    return table.assign(training=table["agent"].map(training))


def score_anchors(
    stimuli: pd.DataFrame,
    answers: Mapping[str, ScenarioAnswers],
    scenario: str,
    level: float,
) -> pd.DataFrame:
    """Return one row for each anchor of `anchors.COMPUTED`, people first; empty without people.

    ``stimuli``: `Comparison.stimuli` of all files; the anchors answer each stimulus once.
    """
    scores, given = anchor_scores(stimuli, level), anchor_stimuli(stimuli)
    if scores.empty:
        return scores
    rows = pd.concat([given, seen_stimuli(stimuli)], ignore_index=True)
    table = _scored(scores, rows, answers, scenario, level).assign(
        rank=pd.Series(dtype="Int64"), training="", file="", versions="", sha256="", license=""
    )
    table["kind"] = table["kind"].mask(table["agent"] == TWO_PEOPLE, PEOPLE)
    return table.sort_values("kind", key=lambda kind: kind != PEOPLE, kind="stable")


def _scored(
    scores: pd.DataFrame,
    stimuli: pd.DataFrame,
    answers: Mapping[str, ScenarioAnswers],
    scenario: str,
    level: float,
) -> pd.DataFrame:
    """Return the scores of one scenario, or of a mean, with the metrics of participants added."""
    chosen = scores[scores["scenario"] == scenario]
    if chosen.empty:
        raise BadInputError(f"nothing of scenario {scenario!r} can be compared")
    scored = [
        f"{metric.name}{end}"
        for metric in leaderboard_metrics()
        if metric.in_scores
        for end in ("", "_low", "_high")
    ]
    names = ["agent", "kind", "model", "readout", "stimuli", "reason", "ceiling", "floor"]
    table = chosen[[*names, *scored]].copy()
    table["r_of_ceiling"] = table["r"] / table["ceiling"]
    counts = stimuli.groupby("agent")["scenario"].nunique()
    table["scenarios"] = table["agent"].map(counts) if scenario in (MEAN, POOLED) else 1
    if stimuli["p_yes"].isna().all():
        return table
    for metric in leaderboard_metrics():
        if metric.in_scores:
            continue
        table[[metric.name, f"{metric.name}_low", f"{metric.name}_high"]] = np.nan
        if answers:
            _add_metric(table, metric, stimuli, answers, scenario, level)
        else:
            why = f"{metric.name}: needs the answers of single participants"
            table["reason"] = _also(table["reason"], why)
    return table


def _add_metric(
    table: pd.DataFrame,
    metric: Metric,
    stimuli: pd.DataFrame,
    answers: Mapping[str, ScenarioAnswers],
    scenario: str,
    level: float,
) -> None:
    """Add a metric with participants: mean over scenarios, interval about other participants."""
    key = metric.name
    for index, agent in table["agent"].items():
        subset = stimuli[stimuli["agent"] == agent]
        compute = metric.of_two_people if agent == TWO_PEOPLE else metric
        names = subset["scenario"].unique() if scenario in (MEAN, POOLED) else [scenario]
        if scenario == POOLED or any(name not in answers for name in names):
            why = f"{key}: pooled over scenarios nobody answered all stimuli"
            if scenario != POOLED:
                why = f"{key}: no answers of single participants for every scenario"
            table.loc[index, "reason"] = "; ".join(filter(None, [table["reason"][index], why]))
            continue
        values, variances = [], []
        for name in names:
            models, _ = models_of(subset[subset["scenario"] == name], answers[name])
            values.append(float(compute(sample_of_models(models, answers[name]))[0, 0]))
            found = sampling_variances(models, answers[name], {key: compute}, "people")[key]
            variances.append(found.of(0))
        value = float(np.mean(values))
        low, high = mean_of(variances).interval(value, level, metric.scale)
        table.loc[index, [key, f"{key}_low", f"{key}_high"]] = [value, low, high]
        if not np.isfinite(value):
            why = f"{key}: undefined, model and people always give the same one answer"
            table.loc[index, "reason"] = "; ".join(filter(None, [table["reason"][index], why]))


def _also(reasons: pd.Series, why: str) -> pd.Series:
    return reasons.where(reasons == "", reasons + "; ") + why
