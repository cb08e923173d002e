"""How much a measure of models varies with other people, other stimuli, or both.

An interval is about the expected value of the measure with other people, or stimuli, of the same
number. The averages of people are noisy, which raises the RMSD and lowers r, in the value and in
its expectation alike; `agreement.ceiling` and `agreement.rmsd_floor` state how much.

References
----------
P. McCullagh, *Resampling and exchangeable arrays*, Bernoulli 6, 2000, 285-301: no bootstrap is
exact for people crossed with stimuli.
A. B. Owen, *The pigeonhole bootstrap*, Annals of Applied Statistics 1, 2007, 386-411: drawing both
counts the noise of single answers three times.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from physion.analysis.metrics import metrics
from physion.analysis.models.model_people import Models, sample_of_models
from physion.analysis.people.answers import ScenarioAnswers
from physion.analysis.sample import Resampled, Sample
from physion.analysis.statistics.jackknife import Variance, add, jackknife, second_order
from physion.core.seeds import generator

Array = npt.NDArray[np.float64]
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
    - people: jackknife over people, less its excess of second order (`jackknife.second_order`),
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
    """Return all pairs of n people, or `PAIRS` of them; none for two people alone."""
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
