"""Scores of models, of people and of baselines by stimulus: tables with intervals.

- `score_table`: every metric, one row per model and scenario, then their mean and the pooled
  stimuli; `people_table`: the people themselves.
- baselines (`OUTCOME`, `MAJORITY`, `TWO_PEOPLE`): what a score is worth.

`with_participants` has the measures that need the answers of single participants.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.intervals import (
    Bootstrap,
    Integers,
    Variance,
    delete_one,
    jackknife,
    mean_of,
    variance_of_mean,
)
from physion.analysis.metrics import metrics, score_metrics
from physion.analysis.sample import Sample, pool, sample_of_rows
from physion.analysis.statistics import agreement
from physion.analysis.tables import DETECTION, MEAN, POOLED, in_order

Array = npt.NDArray[np.float64]
Compute = Callable[[Sample], dict[str, Array]]
"""Function from a `Sample` to the values of every metric, each of shape (1 + n,): of all stimuli,
then without each of the n stimuli of all scenarios."""

Explain = Callable[[pd.DataFrame], dict[str, str]]
"""Function from rows of stimuli to reasons for what is undefined, by the label of the metric."""


def score_table(stimuli: pd.DataFrame) -> pd.DataFrame:
    """Return the scores of every model.

    ``stimuli``: one row per model and stimulus, as `Comparison.stimuli`. Intervals are about other
    stimuli of the same number in each scenario, with the same people (`jackknife`).

    Returns
    -------
    For each ``model`` its scenarios, then `MEAN` and `POOLED`. Columns: ``model``, ``base_model``,
    ``readout``, ``scenario``; counts of ``stimuli`` and of ``changed`` ones, whose simulated
    outcome is not the official one; every metric of `score_metrics` with ``_low`` and
    ``_high``; ``ceiling`` of r and ``floor`` of the RMSD; ``reason``: why a score or an interval is
    NaN, or means less than it seems to (for example if all labels are of one class); else empty.
    The readout `DETECTION` has no metric that compares it with people.
    """
    # Sorted, so that rounding does not depend on the order of the files.
    ordered = stimuli.sort_values("stimulus", kind="stable")
    parts = [
        _scenario_rows(rows, _of_models, _why_undefined)
        for _, rows in ordered.groupby("model", sort=False)
    ]
    table = _without_likeness(pd.concat(parts, ignore_index=True))
    rank = {model: position for position, model in enumerate(stimuli["model"].unique())}
    return table.sort_values("model", key=lambda a: a.map(rank), kind="stable").reset_index(
        drop=True
    )


def _without_likeness(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table without the metrics that compare rows of `DETECTION` with people."""
    likeness = [m for m in score_metrics() if m.needs == "people" and m.name != "human_accuracy"]
    names, labels = [m.name for m in likeness], {m.label for m in likeness} | {"ceiling"}
    why = f"likeness to people: not of {DETECTION}, which sees the outcome"
    given = (table["readout"] == DETECTION) & table[names].notna().any(axis=1)
    for row in table.index[given]:
        known = str(table.loc[row, "reason"]).split("; ")
        kept = [part for part in known if part and part.partition(":")[0] not in labels]
        table.loc[row, "reason"] = "; ".join([*kept, why])
    columns = [f"{name}{end}" for name in names for end in ("", "_low", "_high")]
    table.loc[given, columns] = np.nan
    return table


def two_people_table(stimuli: pd.DataFrame) -> pd.DataFrame:
    """Return the scores of one person with another, with the columns of `score_table`.

    ``stimuli`` has one row per stimulus, whose predictions do not matter. Metrics that are not
    defined for two people are NaN.
    """
    ordered = stimuli.sort_values("stimulus", kind="stable")
    return _scenario_rows(ordered, _of_two_people, _why_no_pair)


def _scenario_rows(rows: pd.DataFrame, scores: Compute, why: Explain) -> pd.DataFrame:
    names = in_order(rows["scenario"])
    parts = [rows[rows["scenario"] == name] for name in names]
    weights, strata = delete_one([len(part) for part in parts])
    samples = [sample_of_rows(part, each) for part, each in zip(parts, weights, strict=True)]
    by_scenario = [scores(sample) for sample in samples]
    mean = {key: np.mean([values[key] for values in by_scenario], axis=0) for key in by_scenario[0]}
    reasons = [why(part) for part in parts]
    records = []
    for at, (name, part, because) in enumerate(zip(names, parts, reasons, strict=True)):
        own = np.concatenate([[True], strata == at])
        values_of = {key: values[own] for key, values in by_scenario[at].items()}
        records.append(_record(name, part, values_of, None, [*because.values()]))
    one_class = [name for name, part in zip(names, parts, strict=True) if _one_class(part)]
    undefined: dict[str, list[str]] = {}
    for name, because in zip(names, reasons, strict=True):
        for label in because:
            undefined.setdefault(label, []).append(name)
    whys = [f"{label}: undefined in {', '.join(where)}" for label, where in undefined.items()]
    whys += [f"labels: of one class in {', '.join(one_class)}"] if one_class else []
    records.append(_record(MEAN, rows, mean, strata, whys))
    for key in ("ceiling", "floor"):
        records[-1][key] = float(np.mean([record[key] for record in records[:-1]]))
    pooled = scores(pool(samples))
    records.append(_record(POOLED, rows, pooled, strata, [*why(rows).values()]))
    table = pd.DataFrame(records)
    for position, column in enumerate(("model", "base_model", "readout")):
        table.insert(position, column, rows[column].iloc[0])
    return table


def _of_models(sample: Sample) -> dict[str, Array]:
    """Return the values of every metric by stimulus."""
    return {metric.name: metric(sample)[:, 0] for metric in score_metrics()}


def _of_two_people(sample: Sample) -> dict[str, Array]:
    """Return the values of every metric for one person with another, likewise."""
    return {metric.name: metric.of_two_people(sample)[:, 0] for metric in score_metrics()}


def _why_undefined(rows: pd.DataFrame) -> dict[str, str]:
    """Return why metrics of a model are undefined, by their label."""
    if why := agreement.why_no_r(rows["p_contact"], rows["p_yes"]):
        return {"r": why}
    why = agreement.why_no_r_within(rows["p_contact"], rows["p_yes"], rows["label"])
    return {"r beyond the outcome": why} if why else {}


def _why_no_pair(rows: pd.DataFrame) -> dict[str, str]:
    """Return why kappa of two people is undefined."""
    if (rows["count"] < 2).any():
        return {"kappa": "kappa: needs two answers to every stimulus"}
    return {}


def _one_class(rows: pd.DataFrame) -> bool:
    """Return whether several stimuli all have the same label."""
    return len(rows) > 1 and rows["label"].nunique() == 1


def _record(
    name: str,
    rows: pd.DataFrame,
    values_of: dict[str, Array],
    strata: Integers | None,
    whys: list[str],
) -> dict[str, Any]:
    reasons = [*whys]
    if name != MEAN and _one_class(rows):
        word = "contact" if bool(rows["label"].iloc[0]) else "no contact"
        reasons.append(f"labels: all {word}, so accuracy cannot tell knowing from always saying it")
    record: dict[str, Any] = {
        "scenario": name,
        "stimuli": len(rows),
        "changed": int((rows["label"] != rows["simulated"]).sum()),
    }
    for key, values in values_of.items():
        metric = metrics.get(key)
        variance = jackknife(values[1:], strata, counts=metric.counts)
        low, high = variance.interval(float(values[0]), scale=metric.scale)
        if np.isfinite(values[0]) and np.isnan(low) and len(rows) > 1:
            name = metric.label or key
            reasons.append(f"{name}: no interval, too few stimuli or undefined without one of them")
        record |= {key: float(values[0]), f"{key}_low": low, f"{key}_high": high}
    if len(rows) > 1 and record["accuracy_low"] == record["accuracy_high"]:
        reasons.append("accuracy: all answers alike, so the interval has no width")
    if len(rows) == 1:
        reasons.append("intervals: one stimulus")
    if np.isfinite(values_of["r"][0]) and np.isnan(values_of["r_same"][0]):
        reasons.append("r, same outcome: too few or constant where the outcomes agree")
    record["ceiling"] = agreement.ceiling(rows["p_yes"], rows["count"])
    record["floor"] = agreement.rmsd_floor(rows["p_yes"], rows["count"])
    if np.isfinite(values_of["r"][0]) and np.isnan(record["ceiling"]):
        reasons.append("ceiling: people too few or too alike to estimate it")
    record["reason"] = "; ".join(reasons)
    return record


def against_people(scores: pd.DataFrame, people: pd.DataFrame) -> pd.DataFrame:
    """Return ``scores`` with how its accuracies compare with people's.

    Parameters
    ----------
    scores
        Table with ``scenario``, ``readout``, ``accuracy``, ``difference_low`` and
        ``difference_high``.
    people
        From `people_table`.

    Returns
    -------
    Two columns more, empty where nothing is known and for the readout `DETECTION`. ``reliably``:
    *better* or *worse* if the interval of the difference to people on the same stimuli excludes 0.
    ``people_interval``: whether the accuracy is *below*, *inside* or *above* the interval of
    people's accuracy by drawing participants, as preregistered.
    """
    low, high = scores["difference_low"], scores["difference_high"]
    known = people.set_index("scenario")[list(BOOTSTRAP)].reindex(scores["scenario"])
    first, last = known.to_numpy(np.float64).T
    value = scores["accuracy"].to_numpy(np.float64)
    inside = (value >= first) & (value <= last)
    place = np.select([value < first, inside, value > last], ["below", "inside", "above"], "")
    return scores.assign(
        reliably=np.select([low > 0, high < 0], ["better", "worse"], ""),
        people_interval=np.where(scores["readout"] == DETECTION, "", place),
    )


def runs_table(scores: pd.DataFrame, bootstrap: Bootstrap | None = None) -> pd.DataFrame:
    """Return the accuracy of each model over its runs, as the paper's table by scenario has it.

    Parameters
    ----------
    scores
        From `score_table`, with ``kind``. A run is one of its models: a readout, a training and a
        seed of a base model.
    bootstrap
        Draws of the runs.

    Returns
    -------
    ``base_model``, ``scenario`` (with `MEAN`), ``runs``, ``accuracy`` with ``_low`` and ``_high``:
    the mean over runs, and the interval by drawing runs with replacement. Models of a single run
    are left out.
    """
    draws = bootstrap or Bootstrap()
    rows = scores[(scores["kind"] == "model") & (scores["scenario"] != POOLED)]
    records = []
    for model, own in rows.groupby("base_model", sort=False):
        for scenario in [*in_order(set(own["scenario"]) - {MEAN}), MEAN]:
            values = own.loc[own["scenario"] == scenario, "accuracy"].to_numpy(np.float64)
            if len(values) > 1:
                drawn = draws.weights("runs", len(values)) @ values / len(values)
                interval = draws.interval(drawn)
                records.append((model, scenario, len(values), float(values.mean()), *interval))
    columns = ["base_model", "scenario", "runs", "accuracy", "accuracy_low", "accuracy_high"]
    return pd.DataFrame(records, columns=columns)


def shown_average(scores: pd.DataFrame) -> str:
    """Return which average is shown first: `MEAN`, or `POOLED` if that has more numbers.

    Scenarios of few stimuli leave no mean. ``scores``: a table with ``kind``, ``scenario``,
    ``accuracy`` and ``r``, in which the models decide, if there are any.
    """
    models = scores[scores["kind"] == "model"]
    rows = scores if models.empty else models
    known = rows[["accuracy", "r"]].notna().sum(axis=1).groupby(rows["scenario"]).sum()
    return POOLED if known.get(POOLED, 0) > known.get(MEAN, 0) else MEAN


def scenario_counts(scores: pd.DataFrame) -> pd.Series:
    """Return the number of scenarios of each model (index) in a table of scores."""
    own = scores[~scores["scenario"].isin([MEAN, POOLED])]
    return own.groupby("model")["scenario"].nunique()


AVERAGES = {MEAN: "mean over scenarios", POOLED: "all stimuli pooled"}
"""Words for the averages."""


BOOTSTRAP = ("bootstrap_low", "bootstrap_high")


def people_table(people: pd.DataFrame, zone: pd.DataFrame | None) -> pd.DataFrame:
    """Return the people by scenario and, in row `MEAN`, averaged over scenarios.

    ``people`` has one row per stimulus, from `with_labels`.

    Columns: ``scenario``, ``stimuli``, ``people`` (median number a stimulus), ``base_rate``
    (fraction of stimuli with contact), ``yes`` (mean fraction who say yes), ``accuracy`` with
    ``_low`` and ``_high`` (jackknife over stimuli), ``reliability`` and ``ceiling`` (see
    `agreement`), and, NaN unless ``zone`` contains it, ``bootstrap_low``, ``bootstrap_high``: the
    interval of the accuracy by drawing participants, as preregistered, and ``zone_low``,
    ``zone_high``: the middle 95 % of participants, always NaN in the mean, as the people of
    different scenarios are not one sample.
    """
    zones = {} if zone is None else zone.set_index("scenario").T.to_dict()
    records, variances = [], []
    for name in in_order(people["scenario"]):
        rows = people[people["scenario"] == name].sort_values("stimulus", kind="stable")
        variances.append(variance_of_mean(rows["accuracy"].to_numpy(dtype=np.float64)))
        records.append(_people_record(name, rows, variances[-1], zones.get(name, {})))
    table = pd.DataFrame(records)
    low, high = mean_of(variances).interval(float(table["accuracy"].mean()), scale="fraction")
    averaged = ["people", "base_rate", "yes", "accuracy", "reliability", "ceiling"]
    mean = {"scenario": MEAN, "stimuli": len(people), "accuracy_low": low, "accuracy_high": high}
    mean |= {column: float(table[column].mean(skipna=False)) for column in averaged}
    mean |= {column: zones.get(MEAN, {}).get(column, np.nan) for column in BOOTSTRAP}
    return pd.concat([table, pd.DataFrame([mean])], ignore_index=True)


def _people_record(
    name: str, rows: pd.DataFrame, variance: Variance, zone: dict[str, float]
) -> dict[str, Any]:
    low, high = variance.interval(float(rows["accuracy"].mean()), scale="fraction")
    return {
        "scenario": name,
        "stimuli": len(rows),
        "people": float(np.median(rows["count"])),
        "base_rate": float(np.mean(rows["label"].to_numpy(dtype=bool))),
        "yes": float(rows["p_yes"].mean()),
        "accuracy": float(rows["accuracy"].mean()),
        "accuracy_low": low,
        "accuracy_high": high,
        **{column: zone.get(column, np.nan) for column in BOOTSTRAP},
        "reliability": agreement.reliability(rows["p_yes"], rows["count"]),
        "ceiling": agreement.ceiling(rows["p_yes"], rows["count"]),
        "zone_low": zone.get("low", np.nan),
        "zone_high": zone.get("high", np.nan),
    }


# Baselines of the tables of results: what a model's score is worth.
#
# Three are computed from the answers of people and the official outcomes, without a model:
#
# - `OUTCOME`: answers with the official outcome, as a perfect simulator would;
# - `MAJORITY`: answers as most people did (no where they are divided equally): no answer of yes or
#   no agrees with single people more often, so its kappa is the ceiling of models;
# - `TWO_PEOPLE`: one person in place of the model, compared with another one.
#
# Others come as predictions of models whose names are in `BASELINE_MODELS`.

OUTCOME = "recorded outcome"
MAJORITY = "majority of people"
TWO_PEOPLE = "one person with another"
COMPUTED = (OUTCOME, MAJORITY, TWO_PEOPLE)
"""Names of the baselines that need no predictions."""

BASELINE_MODELS = frozenset(
    {
        "state-trees",
        "already-touched",
        "constant-motion",
        "blob-centroids",
        "blob-trees",
        "mask-trees",
        "copy-last-frame",
        "chance",
    }
)
"""Names of models whose predictions are baselines."""

Kind = Literal["model", "baseline"]


def kind_of(name: str) -> Kind:
    """Return whether a row of a table is about a model or a baseline, by its name only."""
    model = name.partition(" · ")[0]
    return "baseline" if model in BASELINE_MODELS or name in COMPUTED else "model"


def seen_stimuli(stimuli: pd.DataFrame) -> pd.DataFrame:
    """Return each stimulus that people answered once, as rows of `TWO_PEOPLE`.

    ``stimuli`` and the result have the columns of `Comparison.stimuli`; the predictions
    are the outcomes and mean nothing. It is empty without people.
    """
    seen = stimuli[stimuli["p_yes"].notna()].drop_duplicates("stimulus")
    return _answering(seen, TWO_PEOPLE, seen["label"].astype(bool))


def baseline_stimuli(stimuli: pd.DataFrame) -> pd.DataFrame:
    """Return the answers of `OUTCOME` and `MAJORITY` to the stimuli that people answered.

    ``stimuli`` and the result have the columns of `Comparison.stimuli`; the result is
    about each stimulus once, and P(contact) is 0 or 1. Without people it has no rows.
    """
    seen = seen_stimuli(stimuli)
    answers = {OUTCOME: seen["label"].astype(bool), MAJORITY: seen["p_yes"] > 0.5}
    parts = [_answering(seen, name, given) for name, given in answers.items()]
    return pd.concat(parts, ignore_index=True)


def _answering(seen: pd.DataFrame, name: str, yes: pd.Series) -> pd.DataFrame:
    """Return the rows of ``seen`` with the answers ``yes`` of a baseline."""
    table = seen.assign(
        model=name, base_model=name, readout="", predicted=yes, p_contact=yes.astype(float)
    )
    return table.assign(gap=table["p_contact"] - table["p_yes"]).reset_index(drop=True)


def baseline_scores(stimuli: pd.DataFrame) -> pd.DataFrame:
    """Return `with_kind` of the scores of the computed baselines; empty without people.

    ``stimuli``: as for `baseline_stimuli`.
    """
    seen, answers = seen_stimuli(stimuli), baseline_stimuli(stimuli)
    if seen.empty:
        return pd.DataFrame()
    parts = [score_table(answers)] if len(answers) else []
    parts.append(two_people_table(seen))
    return with_kind(pd.concat(parts, ignore_index=True))


def with_kind(scores: pd.DataFrame, names: str = "model") -> pd.DataFrame:
    """Return a table with the column ``kind`` after the column of the names of models."""
    table = scores.copy()
    kinds = [kind_of(str(name)) for name in scores[names]]
    table.insert(list(table.columns).index(names) + 1, "kind", kinds)
    return table
