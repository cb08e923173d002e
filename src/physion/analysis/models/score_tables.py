"""Tables of scores: one row a model and scenario, then their mean and the pooled stimuli."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.metrics import metrics, score_metrics
from physion.analysis.sample import Sample, pool, sample_of_rows
from physion.analysis.statistics import agreement
from physion.analysis.statistics.jackknife import (
    Integers,
    Variance,
    delete_one,
    jackknife,
    mean_of,
    variance_of_mean,
)
from physion.analysis.tables.stimuli import MEAN, POOLED, in_order

Array = npt.NDArray[np.float64]
Compute = Callable[[Sample], dict[str, Array]]
"""Function from a `Sample` to the values of every metric, each of shape (1 + n,): of all stimuli,
then without each of the n stimuli of all scenarios."""

Explain = Callable[[pd.DataFrame], dict[str, str]]
"""Function from rows of stimuli to reasons for what is undefined, by the label of the metric."""


def score_table(stimuli: pd.DataFrame, level: float = 0.95) -> pd.DataFrame:
    """Return the scores of every model.

    Parameters
    ----------
    stimuli
        One row a model and stimulus, as `comparison.Comparison.stimuli`.
    level
        Level of the intervals, which are about other stimuli of the same number in each scenario,
        with the same people (`jackknife`).

    Returns
    -------
    For each ``agent`` its scenarios, then `MEAN` and `POOLED`. Columns: ``agent``, ``model``,
    ``readout``, ``scenario``; counts of ``stimuli`` and of ``changed`` ones, whose simulated
    outcome is not the official one; every metric of `metrics.score_metrics` with ``_low`` and
    ``_high``; ``ceiling`` of r and ``floor`` of the RMSD; ``reason``: why a score or an interval is
    NaN, or means less than it seems to (for example if all labels are of one class); else empty.
    """
    # Sorted, so that rounding does not depend on the order of the files.
    ordered = stimuli.sort_values("stimulus", kind="stable")
    parts = [
        _agent_rows(rows, level, _of_models, _why_undefined)
        for _, rows in ordered.groupby("agent", sort=False)
    ]
    table = pd.concat(parts, ignore_index=True)
    rank = {agent: position for position, agent in enumerate(stimuli["agent"].unique())}
    return table.sort_values("agent", key=lambda a: a.map(rank), kind="stable").reset_index(
        drop=True
    )


def two_people_table(stimuli: pd.DataFrame, level: float = 0.95) -> pd.DataFrame:
    """Return the scores of one person with another, with the columns of `score_table`.

    ``stimuli`` has a row for each stimulus, whose predictions do not matter. Metrics that are not
    defined for two people are NaN.
    """
    ordered = stimuli.sort_values("stimulus", kind="stable")
    return _agent_rows(ordered, level, _of_two_people, _why_no_pair)


def _agent_rows(rows: pd.DataFrame, level: float, scores: Compute, why: Explain) -> pd.DataFrame:
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
        records.append(_record(name, part, values_of, None, level, [*because.values()]))
    one_class = [name for name, part in zip(names, parts, strict=True) if _one_class(part)]
    undefined: dict[str, list[str]] = {}
    for name, because in zip(names, reasons, strict=True):
        for label in because:
            undefined.setdefault(label, []).append(name)
    whys = [f"{label}: undefined in {', '.join(where)}" for label, where in undefined.items()]
    whys += [f"labels: of one class in {', '.join(one_class)}"] if one_class else []
    records.append(_record(MEAN, rows, mean, strata, level, whys))
    for key in ("ceiling", "floor"):
        records[-1][key] = float(np.mean([record[key] for record in records[:-1]]))
    pooled = scores(pool(samples))
    records.append(_record(POOLED, rows, pooled, strata, level, [*why(rows).values()]))
    table = pd.DataFrame(records)
    for position, column in enumerate(("agent", "model", "readout")):
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
    level: float,
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
        low, high = variance.interval(float(values[0]), level, metric.scale)
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


def people_table(
    people: pd.DataFrame, zone: pd.DataFrame | None, level: float = 0.95
) -> pd.DataFrame:
    """Return the people by scenario and, in row `MEAN`, averaged over scenarios.

    ``people`` has a row a stimulus, from `responses.with_labels`.

    Columns: ``scenario``, ``stimuli``, ``people`` (median number a stimulus), ``base_rate``
    (fraction of stimuli with contact), ``yes`` (mean fraction who say yes), ``accuracy`` with
    ``_low`` and ``_high`` (jackknife over stimuli), ``reliability`` and ``ceiling`` (see
    `agreement`), and ``zone_low``, ``zone_high``: the middle 95 % of participants if ``zone``
    contains it, else NaN; always NaN in the mean, since nobody took part in more than one scenario.
    """
    zones = {} if zone is None else zone.set_index("scenario")[["low", "high"]].T.to_dict()
    records, variances = [], []
    for name in in_order(people["scenario"]):
        rows = people[people["scenario"] == name].sort_values("stimulus", kind="stable")
        variances.append(variance_of_mean(rows["accuracy"].to_numpy(dtype=np.float64)))
        records.append(_people_record(name, rows, variances[-1], zones.get(name, {}), level))
    table = pd.DataFrame(records)
    low, high = mean_of(variances).interval(float(table["accuracy"].mean()), level, "fraction")
    averaged = ["people", "base_rate", "yes", "accuracy", "reliability", "ceiling"]
    mean = {"scenario": MEAN, "stimuli": len(people), "accuracy_low": low, "accuracy_high": high}
    mean |= {column: float(table[column].mean(skipna=False)) for column in averaged}
    return pd.concat([table, pd.DataFrame([mean])], ignore_index=True)


def _people_record(
    name: str, rows: pd.DataFrame, variance: Variance, zone: dict[str, float], level: float
) -> dict[str, Any]:
    low, high = variance.interval(float(rows["accuracy"].mean()), level, "fraction")
    return {
        "scenario": name,
        "stimuli": len(rows),
        "people": float(np.median(rows["count"])),
        "base_rate": float(np.mean(rows["label"].to_numpy(dtype=bool))),
        "yes": float(rows["p_yes"].mean()),
        "accuracy": float(rows["accuracy"].mean()),
        "accuracy_low": low,
        "accuracy_high": high,
        "reliability": agreement.reliability(rows["p_yes"], rows["count"]),
        "ceiling": agreement.ceiling(rows["p_yes"], rows["count"]),
        "zone_low": zone.get("low", np.nan),
        "zone_high": zone.get("high", np.nan),
    }
