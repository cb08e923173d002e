"""Measures of models with the single participants of a scenario, and their intervals.

A *measure* of a model compares it with the people of the scenario; the *zone* of a measure is the
range of single people (or pairs, or halves of them) from the 2.5th to the 97.5th percentile.
Intervals are about other people, other stimuli, or both; they answer different questions, so each
is named. `sampling_variance` contains the method.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.metrics import measure_metrics, metrics
from physion.analysis.models.model_people import Models, sample_of_models
from physion.analysis.models.sampling_variance import sampling_variances
from physion.analysis.people.answers import ScenarioAnswers
from physion.analysis.sample import RESAMPLED, Resampled, Sample
from physion.analysis.statistics import agreement
from physion.analysis.statistics.jackknife import Variance, mean_of
from physion.analysis.tables.stimuli import MEAN

Array = npt.NDArray[np.float64]

TABLE_COLUMNS = (
    *("model", "scenario", "measure", "stimuli", "value"),
    *(f"{end}_{what}" for what in RESAMPLED for end in ("low", "high")),
    *("pair_low", "pair_median", "pair_high", "undefined", "reason"),
)


@dataclass(frozen=True)
class Measured:
    """Measures of one model in one scenario, with their sampling variances.

    - ``model``, ``scenario``; ``stimuli``: number of stimuli that the model predicts;
    - ``values[measure]``; ``reasons[measure]``: why the value is NaN;
    - ``variances[what][measure]`` for each of `sample.RESAMPLED`, absent if the measure does not
      depend on what is drawn;
    - ``by_participant[measure]`` (people,), for measures with a value for each participant.
    """

    model: str
    scenario: str
    stimuli: int
    values: dict[str, float]
    reasons: dict[str, str]
    variances: dict[Resampled, dict[str, Variance]]
    by_participant: dict[str, Array]


def measure_models(
    models: Models, answers: ScenarioAnswers, two_people: str = ""
) -> list[Measured]:
    """Compute every measure of every model, and its sampling variances.

    ``two_people``: name of a further row, at the end, with the measures of one person with another
    that are defined; empty: there is none.
    """
    sample = sample_of_models(models, answers)
    chosen = measure_metrics()
    values = {metric.name: metric(sample)[0] for metric in chosen}
    each = {m.name: m.by_participant(sample) for m in chosen if m.by_participant is not None}
    variances = {
        what: sampling_variances(
            models, answers, {m.name: m for m in chosen if what in m.resampled}, what
        )
        for what in RESAMPLED
    }
    rows = []
    for k, name in enumerate(models.names):
        of_model = {measure: float(value[k]) for measure, value in values.items()}
        undefined = [measure for measure, value in of_model.items() if not np.isfinite(value)]
        rows.append(
            Measured(
                model=name,
                scenario=answers.scenario,
                stimuli=int(np.sum(~np.isnan(models.p_contact[k]))),
                values=of_model,
                reasons={measure: _why(measure, k, models, answers) for measure in undefined},
                variances={what: _of_model(found, k) for what, found in variances.items()},
                by_participant={measure: value[:, k] for measure, value in each.items()},
            )
        )
    return [*rows, _two_people(two_people, models, answers, sample)] if two_people else rows


def _of_model(variances: Mapping[str, Variance], k: int) -> dict[str, Variance]:
    return {name: variance.of(k) for name, variance in variances.items()}


def _two_people(name: str, models: Models, answers: ScenarioAnswers, sample: Sample) -> Measured:
    computes: dict[str, Callable[[Sample], Array]] = {
        metric.name: metric.of_two_people
        for metric in measure_metrics()
        if metric.two_people is not None
    }
    values = {measure: float(compute(sample)[0, 0]) for measure, compute in computes.items()}
    undefined = [measure for measure, value in values.items() if not np.isfinite(value)]
    return Measured(
        model=name,
        scenario=answers.scenario,
        stimuli=len(answers.stimuli),
        values=values,
        reasons=dict.fromkeys(undefined, "needs two answers to every stimulus, not all alike"),
        variances={
            what: _of_model(sampling_variances(models, answers, computes, what), 0)
            for what in RESAMPLED
        },
        by_participant={},
    )


def measure_table(measured: Sequence[Measured], level: float = 0.95) -> pd.DataFrame:
    """Return one row a model and measure.

    Columns: ``model``, ``scenario``, ``measure``, ``stimuli``, ``value``; ``low`` and ``high`` with
    ``_people``, ``_stimuli``, ``_both`` (interval by what is drawn, at this ``level``); for
    measures by participant also ``pair_low``, ``pair_median``, ``pair_high`` (percentiles over
    participants) and ``undefined`` (participants for whom it is NaN); ``reason``.
    """
    records = []
    for one in measured:
        for measure, value in one.values.items():
            variances = {what: one.variances[what].get(measure) for what in RESAMPLED}
            record, reasons = _interval_columns(measure, value, variances, level)
            if measure in one.reasons:
                reasons.insert(0, one.reasons[measure])
            if measure in one.by_participant:
                record |= _over_people(one.by_participant[measure])
            records.append(
                {
                    "model": one.model,
                    "scenario": one.scenario,
                    "measure": measure,
                    "stimuli": one.stimuli,
                    **record,
                    "reason": "; ".join(reasons),
                }
            )
    return pd.DataFrame(records).reindex(columns=list(TABLE_COLUMNS))


def mean_measures(measured: Sequence[Sequence[Measured]]) -> list[Measured]:
    """Return the means over scenarios, whose people and stimuli are drawn independently.

    ``measured`` holds the rows of each scenario, with the same models in the same order. A mean is
    NaN if it is undefined in one of the scenarios.
    """
    return [_mean(rows) for rows in zip(*measured, strict=True)]


def _mean(rows: Sequence[Measured]) -> Measured:
    values, reasons = {}, {}
    variances: dict[Resampled, dict[str, Variance]] = {what: {} for what in RESAMPLED}
    for measure in rows[0].values:
        values[measure] = float(np.mean([one.values[measure] for one in rows]))
        undefined = [one.scenario for one in rows if not np.isfinite(one.values[measure])]
        if undefined:
            reasons[measure] = f"undefined in {', '.join(undefined)}"
        for what in RESAMPLED:
            if all(measure in one.variances[what] for one in rows):
                variances[what][measure] = mean_of([one.variances[what][measure] for one in rows])
    stimuli = sum(one.stimuli for one in rows)
    return Measured(rows[0].model, MEAN, stimuli, values, reasons, variances, {})


def _interval_columns(
    measure: str, value: float, variances: Mapping[Resampled, Variance | None], level: float
) -> tuple[dict[str, Any], list[str]]:
    """Return ``value`` with ``low_`` and ``high_`` by what is drawn, and reasons for what is
    NaN.
    """
    record: dict[str, Any] = {"value": value}
    reasons = []
    for what in RESAMPLED:
        low, high = np.nan, np.nan
        variance = variances[what]
        if variance is None:
            reasons.append(f"no interval over {what}: they do not enter")
        elif np.isfinite(value):
            scale = metrics.get(measure).scale
            low, high = variance.interval(value, level, scale)
            if np.isnan(low):
                reasons.append(f"no interval over {what}: too few, or undefined without some")
        record |= {f"low_{what}": low, f"high_{what}": high}
    return record, reasons


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
        x, y = models.p_contact[k, known], answers.p_yes()[known]
        why = agreement.why_no_r(x, y)
        return why or agreement.why_no_r_within(x, y, answers.label[known])
    return f"{measure}: it and the people always give the same one answer"
