"""Measures of models with the single participants of a scenario, and their intervals.

A *measure* of a model compares it with the people of the scenario; the *zone* of a measure is the
range of single people (or pairs, or halves of them) from the 2.5th to the 97.5th percentile.
Intervals draw people, stimuli, or both; they answer different questions, so each is named.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.metrics import measure_metrics
from physion.analysis.models.model_people import Models, sample_of_models
from physion.analysis.people.answers import ScenarioAnswers
from physion.analysis.people.people import draws_of_people
from physion.analysis.sample import RESAMPLED, Resampled, Sample
from physion.analysis.statistics import agreement
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.tables.stimuli import MEAN

Array = npt.NDArray[np.float64]

TABLE_COLUMNS = (
    *("model", "scenario", "measure", "stimuli", "value"),
    *(f"{end}_{what}" for what in RESAMPLED for end in ("low", "high")),
    *("pair_low", "pair_median", "pair_high", "undefined", "reason"),
)


@dataclass(frozen=True)
class Measured:
    """Measures of one model in one scenario, with the resamples for their intervals.

    - ``model``, ``scenario``; ``stimuli``: number of stimuli that the model predicts;
    - ``values[measure]``; ``reasons[measure]``: why the value is NaN;
    - ``draws[what][measure]`` (resamples,) for each of `sample.RESAMPLED`, absent if the measure
      does not depend on the draw;
    - ``by_participant[measure]`` (people,), for measures with a value for each participant.
    """

    model: str
    scenario: str
    stimuli: int
    values: dict[str, float]
    reasons: dict[str, str]
    draws: dict[Resampled, dict[str, Array]]
    by_participant: dict[str, Array]


def measure_models(
    models: Models, answers: ScenarioAnswers, bootstrap: Bootstrap, two_people: str = ""
) -> list[Measured]:
    """Compute every measure of every model, and its resamples.

    ``two_people``: name of a further row, at the end, with the measures of one person with another
    that are defined; empty: there is none.
    """
    sample = sample_of_models(models, answers)
    resamples = _samples(models, answers, bootstrap)
    metrics = measure_metrics()
    values = {metric.name: metric(sample)[0] for metric in metrics}
    each = {m.name: m.by_participant(sample) for m in metrics if m.by_participant is not None}
    draws = {
        what: {m.name: m(drawn) for m in metrics if what in m.resampled}
        for what, drawn in resamples.items()
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
                draws={
                    what: {measure: drawn[:, k] for measure, drawn in by_measure.items()}
                    for what, by_measure in draws.items()
                },
                by_participant={measure: value[:, k] for measure, value in each.items()},
            )
        )
    return [*rows, _two_people(two_people, answers, sample, resamples)] if two_people else rows


def _two_people(
    name: str, answers: ScenarioAnswers, sample: Sample, resamples: Mapping[Resampled, Sample]
) -> Measured:
    metrics = [metric for metric in measure_metrics() if metric.two_people is not None]
    values = {metric.name: float(metric.of_two_people(sample)[0, 0]) for metric in metrics}
    undefined = [measure for measure, value in values.items() if not np.isfinite(value)]
    return Measured(
        model=name,
        scenario=answers.scenario,
        stimuli=len(answers.stimuli),
        values=values,
        reasons=dict.fromkeys(undefined, "needs two answers to every stimulus, not all alike"),
        draws={
            what: {metric.name: metric.of_two_people(drawn)[:, 0] for metric in metrics}
            for what, drawn in resamples.items()
        },
        by_participant={},
    )


def measure_table(measured: Sequence[Measured], bootstrap: Bootstrap) -> pd.DataFrame:
    """Return one row a model and measure.

    Columns: ``model``, ``scenario``, ``measure``, ``stimuli``, ``value``; ``low`` and ``high`` with
    ``_people``, ``_stimuli``, ``_both`` (interval by what is drawn); for measures by participant
    also ``pair_low``, ``pair_median``, ``pair_high`` (percentiles over participants) and
    ``undefined`` (participants for whom it is NaN); ``reason``.
    """
    records = []
    for one in measured:
        for measure, value in one.values.items():
            draws = {what: one.draws[what].get(measure) for what in RESAMPLED}
            record, reasons = _interval_columns(value, draws, bootstrap)
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
    draws: dict[Resampled, dict[str, Array]] = {what: {} for what in RESAMPLED}
    for measure in rows[0].values:
        values[measure] = float(np.mean([one.values[measure] for one in rows]))
        undefined = [one.scenario for one in rows if not np.isfinite(one.values[measure])]
        if undefined:
            reasons[measure] = f"undefined in {', '.join(undefined)}"
        for what in RESAMPLED:
            if all(measure in one.draws[what] for one in rows):
                drawn = [one.draws[what][measure] for one in rows]
                draws[what][measure] = np.mean(drawn, axis=0)
    stimuli = sum(one.stimuli for one in rows)
    return Measured(rows[0].model, MEAN, stimuli, values, reasons, draws, {})


def _interval_columns(
    value: float, draws: Mapping[Resampled, Array | None], bootstrap: Bootstrap
) -> tuple[dict[str, Any], list[str]]:
    """Return ``value`` with ``low_`` and ``high_`` by what is drawn, and reasons for what is
    NaN.
    """
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


def _samples(models: Models, answers: ScenarioAnswers, draws: Bootstrap) -> dict[Resampled, Sample]:
    """Return the resamples for the intervals, by what is drawn."""
    people = draws_of_people(answers, draws)
    stimuli = draws.weights(answers.scenario, len(answers.stimuli))
    return {
        "people": sample_of_models(models, answers, None, people, "people"),
        "stimuli": sample_of_models(models, answers, stimuli, None, "stimuli"),
        "both": sample_of_models(models, answers, stimuli, people, "both"),
    }


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
