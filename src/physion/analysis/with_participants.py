"""Models compared with single participants: measures, three kinds of intervals, human zones.

- `Models`, `models_of`: models and the participants of a scenario as arrays.
- `sampling_variances`: how much a measure varies with other people, other stimuli, or both.
- `measure_models`, `measure_table`: measures with single participants, and their intervals.
- `human_zones`: the range of the same measures among people.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.intervals import (
    Bootstrap,
    Variance,
    add,
    distribution,
    jackknife,
    mean_of,
    second_order,
)
from physion.analysis.metrics import measure_metrics, metrics
from physion.analysis.people.measures import (
    ScenarioAnswers,
    difference_of_pairs,
    draws_of_people,
    mean_over_people,
)
from physion.analysis.sample import RESAMPLED, Resampled, Sample
from physion.analysis.scores import MAJORITY, OUTCOME
from physion.analysis.statistics import agreement
from physion.analysis.statistics.agreement import correctness, correlate_rows, cross_kappa
from physion.analysis.tables import MEAN
from physion.core.errors import BadInputError
from physion.core.seeds import generator

Array = npt.NDArray[np.float64]

# Models and the single participants of one scenario as arrays over the same stimuli.


@dataclass(frozen=True)
class Models:
    """Predictions of models for the stimuli of one scenario, in the order of its answers.

    ``p_contact`` (m, s) in 0..1 and ``predicted`` (m, s) 1 or 0; NaN if a model does not predict
    the stimulus. Raises `BadInputError` for other values or for shapes that do not fit.
    """

    names: tuple[str, ...]
    p_contact: Array
    predicted: Array

    def __post_init__(self) -> None:
        if not self.p_contact.shape == self.predicted.shape:
            raise BadInputError("P(contact) and predicted outcomes differ in shape")
        if len(self.names) != len(self.p_contact) or len(set(self.names)) != len(self.names):
            raise BadInputError("each model needs one name of its own and one row")
        if ((self.p_contact < 0) | (self.p_contact > 1)).any():
            raise BadInputError("a P(contact) does not lie in 0..1")
        if not (np.isnan(self.predicted) | np.isin(self.predicted, (0, 1))).all():
            raise BadInputError("predicted outcomes must be 0, 1 or NaN")
        if (np.isnan(self.predicted) != np.isnan(self.p_contact)).any():
            raise BadInputError("a stimulus needs both P(contact) and a predicted outcome")


def models_of(
    rows: pd.DataFrame, answers: ScenarioAnswers, names: Sequence[str] | None = None
) -> tuple[Models, pd.DataFrame]:
    """Return the models of a table, and a table of what has no counterpart.

    Parameters
    ----------
    rows
        Table with ``model``, ``stimulus``, ``p_contact``, ``predicted``.
    answers
        Answers of people to the scenario, whose stimuli are used.
    names
        Names of the models in the order to use, whether they occur in ``rows`` or not; None: those
        that occur.

    Returns
    -------
    The models, and the table ``model``, ``reason``, ``stimuli``. Raises `BadInputError` if a model
    predicts a stimulus twice.
    """
    twice = rows[rows.duplicated(["model", "stimulus"])]
    if len(twice):
        raise BadInputError(
            f"{twice['model'].iloc[0]!r} answers {twice['stimulus'].iloc[0]!r} twice"
        )
    names = tuple(map(str, rows["model"].unique() if names is None else names))
    grids = [
        rows.pivot(index="model", columns="stimulus", values=column)
        .reindex(index=list(names), columns=list(answers.stimuli))
        .to_numpy(dtype=np.float64)
        for column in ("p_contact", "predicted")
    ]
    unseen = rows[~rows["stimulus"].isin(answers.stimuli)].groupby("model", sort=False).size()
    unmatched = [(model, "people did not see it", int(n)) for model, n in unseen.items()]
    gaps = np.isnan(grids[0]).sum(axis=1)
    unmatched += [(name, "the model does not predict it", int(n))
             for name, n in zip(names, gaps, strict=True) if n]  # fmt: skip
    dropped = pd.DataFrame(unmatched, columns=["model", "reason", "stimuli"])
    return Models(names, grids[0], grids[1]), dropped


def sample_of_models(
    models: Models,
    answers: ScenarioAnswers,
    stimuli: Array | None = None,
    people: Array | None = None,
    drawn: Resampled | None = None,
) -> Sample:
    """Return models and people with weights of stimuli (b, s) and of people (b, n).

    Weights that are None count everything once.
    """
    resamples = 1 if people is None else len(people)
    if stimuli is None:
        stimuli = np.ones((resamples, len(answers.stimuli)))
    p_yes, right = mean_over_people(answers.yes, people), mean_over_people(answers.correct, people)
    everybody = np.ones((len(stimuli), len(answers.sessions)))
    return Sample(
        p_contact=models.p_contact,
        predicted=models.predicted,
        label=answers.label,
        shown=answers.label,
        p_yes=np.atleast_2d(p_yes),
        human_accuracy=np.atleast_2d(right),
        differ=np.atleast_2d(difference_of_pairs(answers.yes, people)),
        stimuli=stimuli,
        answers=answers,
        people=everybody if people is None else people,
        drawn=drawn,
    )


def model_pairs(models: Models, answers: ScenarioAnswers) -> pd.DataFrame:
    """Return kappa and error consistency of every two models.

    Columns: ``first``, ``second``, ``stimuli``, ``kappa``, ``error_consistency``; NaN if undefined.
    """
    right = correctness(models.predicted, answers.label)
    kappa, errors = (cross_kappa(a, a) for a in (models.predicted, right))
    has = (~np.isnan(models.predicted)).astype(np.float64)
    rows = [
        (models.names[i], models.names[j], int((has @ has.T)[i, j]), kappa[i, j], errors[i, j])
        for i, j in zip(*np.triu_indices(len(models.names), 1), strict=True)
    ]
    return pd.DataFrame(rows, columns=["first", "second", "stimuli", "kappa", "error_consistency"])


# How much a measure of models varies with other people, other stimuli, or both.
#
# An interval is about the expected value of the measure with other people, or stimuli, of the same
# number. The averages of people are noisy, which raises the RMSD and lowers r, in the value and in
# its expectation alike; `ceiling` and `rmsd_floor` state how much.
#
# References
# ----------
# P. McCullagh, *Resampling and exchangeable arrays*, Bernoulli 6, 2000, 285-301: no bootstrap is
# exact for people crossed with stimuli.
# A. B. Owen, *The pigeonhole bootstrap*, Annals of Applied Statistics 1, 2007, 386-411: drawing
#   both
# counts the noise of single answers three times.

Computes = Mapping[str, Callable[[Sample], Array]]
"""By name of the metric, functions from a `Sample` to values (b, m)."""

PAIRS = 2000
"""Most pairs of people for the correction of second order."""

SPLITS = 10
"""Random halves of the stimuli for the part of people that all stimuli share."""


def sampling_variances(
    models: Models, answers: ScenarioAnswers, computes: Computes, drawn: Resampled
) -> dict[str, Variance]:
    """Return the variance of measures over other people, stimuli, or both; each of shape (m,).

    - stimuli: jackknife over stimuli; people stay the same.
    - people: jackknife over people, less its excess of second order (`second_order`),
      which may take at most half of it; stimuli stay the same.
    - both: the jackknife over stimuli contains the noise of single answers, since every stimulus
      has answers of its own, but not what a person does in all stimuli. The variance of that part
      is the covariance, over people, of the jackknife values from one half of the stimuli with
      those from the other half. It is added, or nothing if it is below 0.
    """
    if drawn == "people":
        return _over_people(models, answers, computes)
    over_stimuli = _over_stimuli(models, answers, computes)
    if drawn == "stimuli":
        return over_stimuli
    shared = _shared_by_stimuli(models, answers, computes)
    return {name: add([over_stimuli[name], shared[name]]) for name in computes}


def _over_stimuli(
    models: Models, answers: ScenarioAnswers, computes: Computes
) -> dict[str, Variance]:
    without = 1 - np.eye(len(answers.stimuli))
    sample = sample_of_models(models, answers, without, None, "stimuli")
    predicted = ~np.isnan(models.p_contact).T
    variances = {}
    for name, compute in computes.items():
        values = compute(sample)
        # One person with another has one column, for which every stimulus counts.
        used = predicted if values.shape == predicted.shape else None
        counts = name in metrics and metrics.get(name).counts
        variances[name] = jackknife(values, used=used, counts=counts)
    return variances


def _over_people(
    models: Models, answers: ScenarioAnswers, computes: Computes
) -> dict[str, Variance]:
    n = len(answers.sessions)
    if n < 2:
        return _undefined(models, answers, computes)
    pairs = _pairs(n)
    one, two = 1 - np.eye(n), np.ones((len(pairs), n))
    np.put_along_axis(two, pairs, 0.0, axis=1)
    whole = sample_of_models(models, answers)
    sample = sample_of_models(models, answers, None, np.concatenate([one, two]), "people")
    variances = {}
    for name, compute in computes.items():
        values = compute(sample)
        found = jackknife(values[:n])
        if len(pairs):
            excess = second_order(compute(whole)[0], values[:n], values[n:], pairs)
            excess = np.where(np.isfinite(excess), excess, 0.0)
            found = Variance(np.maximum(found.value - excess, found.value / 2), found.df)
        variances[name] = found
    return variances


def _pairs(n: int) -> npt.NDArray[np.int_]:
    """Return all pairs of n people, or `PAIRS` of them; none for two people only."""
    pairs = np.stack(np.triu_indices(n, 1), axis=1)
    if n < 3:
        return pairs[:0]
    if len(pairs) > PAIRS:
        chosen = generator("pairs of people", n).choice(len(pairs), PAIRS, replace=False)
        pairs = pairs[np.sort(chosen)]
    return pairs


def _shared_by_stimuli(
    models: Models, answers: ScenarioAnswers, computes: Computes
) -> dict[str, Variance]:
    """Return the variance over people of what each of them does in all stimuli."""
    people, stimuli = len(answers.sessions), len(answers.stimuli)
    if people < 2:
        return _undefined(models, answers, computes)
    splits = max(2, min(SPLITS, 1000 // people))
    rng = generator("halves of stimuli", stimuli)
    order = rng.permuted(np.tile(np.arange(stimuli), (splits, 1)), axis=1)
    first = (order < stimuli // 2).astype(np.float64)
    halves = np.stack([first, 1 - first], axis=1).reshape(2 * splits, stimuli)
    sample = sample_of_models(
        models,
        answers,
        np.repeat(halves, people, axis=0),
        np.tile(1 - np.eye(people), (2 * splits, 1)),
        "both",
    )
    variances = {}
    for name, compute in computes.items():
        values = compute(sample).reshape(splits, 2, people, -1)
        apart = values - values.mean(axis=2, keepdims=True)
        products = np.sum(apart[:, 0] * apart[:, 1], axis=1) * (people - 1) / people
        shared = _mean_of_defined(products)
        df = np.full(shared.shape, people - 1.0)
        variances[name] = Variance(np.maximum(shared, 0.0), df)
    return variances


def _mean_of_defined(values: Array) -> Array:
    """Return the mean over the first axis of what is defined; NaN where nothing is."""
    known = np.isfinite(values)
    count = known.sum(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(count > 0, np.where(known, values, 0.0).sum(axis=0) / count, np.nan)


def _undefined(models: Models, answers: ScenarioAnswers, computes: Computes) -> dict[str, Variance]:
    whole = sample_of_models(models, answers)
    nothing = {name: np.full(compute(whole)[0].shape, np.nan) for name, compute in computes.items()}
    return {name: Variance(values, values) for name, values in nothing.items()}


def add_baselines(models: Models, answers: ScenarioAnswers) -> Models:
    """Return the models with `OUTCOME` and `MAJORITY` as the last two."""
    rows = {OUTCOME: answers.label, MAJORITY: answers.p_yes() > 0.5}
    added = [row.astype(np.float64)[None] for row in rows.values()]
    return Models(
        (*models.names, *rows),
        np.vstack([models.p_contact, *added]),
        np.vstack([models.predicted, *added]),
    )


# Measures of models with the single participants of a scenario, and their intervals.
#
# A *measure* of a model compares it with the people of the scenario; the *zone* of a measure is
# the range of single people (or pairs, or halves of them) from the 2.5th to the 97.5th percentile.
# Intervals are about other people, other stimuli, or both; they answer different questions, so
# each is named. `sampling_variance` contains the method.

TABLE_COLUMNS = (
    *("model", "scenario", "measure", "stimuli", "value"),
    *(f"{end}_{what}" for what in (*RESAMPLED, "bootstrap") for end in ("low", "high")),
    *("pair_low", "pair_median", "pair_high", "undefined", "reason"),
)


@dataclass(frozen=True)
class Measured:
    """Measures of one model in one scenario, with their sampling variances.

    - ``model``, ``scenario``; ``stimuli``: number of stimuli that the model predicts;
    - ``values[measure]``; ``reasons[measure]``: why the value is NaN;
    - ``variances[what][measure]`` for each of `RESAMPLED`, absent if the measure does not
      depend on what is drawn;
    - ``by_participant[measure]`` (people,), for measures with a value for each participant;
    - ``draws[measure]`` (resamples,): the values with participants drawn with replacement.
    """

    model: str
    scenario: str
    stimuli: int
    values: dict[str, float]
    reasons: dict[str, str]
    variances: dict[Resampled, dict[str, Variance]]
    by_participant: dict[str, Array]
    draws: dict[str, Array]


def measure_models(
    models: Models,
    answers: ScenarioAnswers,
    two_people: str = "",
    bootstrap: Bootstrap | None = None,
) -> list[Measured]:
    """Compute every measure of every model, and how it varies with other people and stimuli.

    Parameters
    ----------
    models, answers
        Models and people of one scenario.
    two_people
        Name of a further row, at the end, with the measures of one person with another that are
        defined; empty: there is none.
    bootstrap
        Draws of participants, the same for every statistic of the scenario.
    """
    sample = sample_of_models(models, answers)
    chosen = measure_metrics()
    weights = draws_of_people(answers, bootstrap or Bootstrap())
    drawn = sample_of_models(models, answers, None, weights, "people")
    draws = {m.name: m(drawn) for m in chosen if "people" in m.resampled}
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
                draws={measure: value[:, k] for measure, value in draws.items()},
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
        draws={},
    )


def measure_table(measured: Sequence[Measured]) -> pd.DataFrame:
    """Return one row per model and measure.

    Columns: ``model``, ``scenario``, ``measure``, ``stimuli``, ``value``; ``low`` and ``high`` with
    ``_people``, ``_stimuli``, ``_both`` (interval by what is drawn) and
    ``_bootstrap`` (percentiles over draws of participants, as preregistered; the noise of their
    averages counts twice in it); for measures by participant also ``pair_low``, ``pair_median``,
    ``pair_high`` (percentiles over participants) and ``undefined`` (participants for whom it is
    NaN); ``reason``.
    """
    records = []
    for one in measured:
        for measure, value in one.values.items():
            variances = {what: one.variances[what].get(measure) for what in RESAMPLED}
            record, reasons = _interval_columns(measure, value, variances)
            if measure in one.reasons:
                reasons.insert(0, one.reasons[measure])
            ends = Bootstrap().interval(one.draws.get(measure, np.empty(0)))
            record |= dict(zip(("low_bootstrap", "high_bootstrap"), ends, strict=True))
            if measure in one.by_participant:
                found = distribution(one.by_participant[measure])
                record |= {f"pair_{end}": found[end] for end in ("low", "median", "high")}
                record["undefined"] = found["undefined"]
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

    ``measured`` holds the rows of each scenario, with the same models in the same order. Scenarios
    of which a model predicts nothing are left out of its mean, which is NaN if it is undefined in
    one of the others.
    """
    return [_mean(rows) for rows in zip(*measured, strict=True)]


def _mean(rows: Sequence[Measured]) -> Measured:
    rows = [one for one in rows if one.stimuli] or rows
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
    draws = {name: np.mean([one.draws[name] for one in rows], axis=0) for name in rows[0].draws}
    return Measured(rows[0].model, MEAN, stimuli, values, reasons, variances, {}, draws)


def _interval_columns(
    measure: str, value: float, variances: Mapping[Resampled, Variance | None]
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
            low, high = variance.interval(value, scale=scale)
            if np.isnan(low):
                reasons.append(f"no interval over {what}: too few, or undefined without some")
        record |= {f"low_{what}": low, f"high_{what}": high}
    return record, reasons


def _why(measure: str, k: int, models: Models, answers: ScenarioAnswers) -> str:
    known = ~np.isnan(models.p_contact[k])
    if not known.any():
        return "the model predicts none of the stimuli"
    if measure == "kappa_gap" and not known.all():
        return "kappa_gap: kappa among people is of all stimuli, of which the model lacks some"
    if measure in ("r", "r_beyond_outcome"):
        x, y = models.p_contact[k, known], answers.p_yes()[known]
        why = agreement.why_no_r(x, y)
        return why or agreement.why_no_r_within(x, y, answers.label[known])
    return f"{measure}: it and the people always give the same one answer"


# Human zones: the range of the same measures among people, to compare models with.

RELEASED_R = "halves, mean of scenarios (the paper's band)"
"""Name in ``of`` for the paper's grey band of r; see `released_r_zone`."""


def human_zones(answers: ScenarioAnswers, halves: Array | None = None) -> pd.DataFrame:
    """Return the range of each measure among single people.

    Columns: ``scenario``, ``measure``, ``of``, ``values`` (their number), ``mean``, ``low``,
    ``median``, ``high`` (2.5th, 50th, 97.5th percentile), ``undefined``.

    ``of`` names whose values they are: ``participants`` (each with the average of the others, or
    the mean kappa with the others: what a model must reach to be indistinguishable from a
    participant), ``pairs`` (kappa of two people, comparable to a model's kappa with single people)
    and ``halves`` (r of two halves of the people; ``halves`` is from `split_halves`). A
    person answers 0 or 1 and no probability, which makes r and RMSD worse; halves are averages and
    reach better values.
    """
    yes, n = answers.yes, len(answers.sessions)
    others = mean_over_people(yes, 1 - np.eye(n))
    right = answers.correct
    kappa, errors = cross_kappa(yes, yes), cross_kappa(right, right)
    for matrix in (kappa, errors):
        np.fill_diagonal(matrix, np.nan)
    distances = np.sqrt(mean_over_people((yes - others).T ** 2))
    upper = np.triu_indices(n, 1)
    ranges: list[tuple[str, str, npt.ArrayLike]] = [
        ("accuracy", "participants", mean_over_people(right.T)),
        ("r", "participants", correlate_rows(yes, others)),
        ("rmsd", "participants", distances),
        ("euclid_over_n", "participants", distances / np.sqrt(np.sum(~np.isnan(yes), axis=1))),
        ("kappa", "participants", mean_over_people(kappa)),
        ("error_consistency", "participants", mean_over_people(errors)),
        ("kappa", "pairs", kappa[upper]),
        ("error_consistency", "pairs", errors[upper]),
    ]
    if halves is not None:
        ranges.append(("r", "halves", halves))
    return pd.DataFrame(
        [
            {"scenario": answers.scenario, "measure": measure, "of": of, **distribution(values)}
            for measure, of, values in ranges
        ]
    )


def released_zone(
    scenario_values: Sequence[float], bootstrap: Bootstrap | None = None
) -> tuple[float, float, float]:
    """Return the grey band of the published panels for accuracy and kappa: mean, low, high.

    It is a bootstrap over the values of the eight scenarios. It shows how far their mean would vary
    with other scenarios, and not how participants differ, so it is not a human zone, although the
    paper names it so. The released code drew without a seed.
    """
    values = np.asarray(scenario_values, dtype=np.float64)
    if not len(values) or not np.isfinite(values).all():
        raise BadInputError("the released zone needs one defined value for each scenario")
    draws = bootstrap or Bootstrap()
    low, high = draws.interval(draws.weights("scenarios", len(values)) @ values / len(values))
    return float(np.mean(values)), low, high


def released_r_zone(zones: pd.DataFrame) -> pd.DataFrame:
    """Return the grey band of the published panel for r, as one row with the columns of
    `human_zones`.

    ``zones`` holds the rows of `human_zones` of several scenarios. The band is the mean over them
    of the 2.5th and of the 97.5th percentile of r between random halves of the people, uncorrected
    for the halved number of people; NaN if a scenario has none. ``values`` counts the scenarios.
    """
    halves = zones[(zones["measure"] == "r") & (zones["of"] == "halves")]
    bounds = halves[["mean", "low", "median", "high"]].mean(skipna=False)
    counts = {"values": len(halves), "undefined": int(halves["low"].isna().sum())}
    names = {"scenario": MEAN, "measure": "r", "of": RELEASED_R}
    return pd.DataFrame([names | bounds.to_dict() | counts])[list(zones.columns)]
