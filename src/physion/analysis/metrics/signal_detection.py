"""Metrics of signal detection: how well a model tells contacts from others, and how it leans."""

from __future__ import annotations

import numpy as np
from scipy import special

from physion.analysis.metrics.registry import register_metric
from physion.analysis.sample import Array, Sample


def _z_rates(sample: Sample) -> tuple[Array, Array]:
    """Return z of the rates of hits and of false alarms, each (b, m).

    Notes
    -----
    With h answers yes at n contacts, z is the normal quantile of (h + 1/2) / (n + 1): the
    log-linear correction, by which d' of a model without an error is finite. NaN without a contact,
    or without a stimulus that has none.
    """
    known = np.isfinite(sample.predicted)
    yes = np.where(known, sample.predicted, 0.0)
    rates = []
    for outcome in (1.0, 0.0):
        members = (sample.label == outcome).astype(np.float64)
        said_yes = sample.stimuli @ (yes * members).T
        of = sample.stimuli @ (known * members).T
        rates.append(np.where(of > 0, special.ndtri((said_yes + 0.5) / (of + 1)), np.nan))
    return rates[0], rates[1]


@register_metric(
    "d_prime",
    label="d′",
    definition="z of the rate of yes at contacts less that at no contacts, with half an answer "
    "added to each side; 0 for guessing",
    better="higher",
    needs="outcome",
    resampled=("stimuli", "both"),
    in_scores=True,
)
def d_prime(sample: Sample) -> Array:
    """Return d' of the model's answers."""
    hits, alarms = _z_rates(sample)
    return hits - alarms


@register_metric(
    "criterion",
    label="criterion",
    definition="minus the mean of the two z of d′; below 0 the model leans to yes",
    better="zero",
    needs="outcome",
    resampled=("stimuli", "both"),
    in_scores=True,
)
def criterion(sample: Sample) -> Array:
    """Return the criterion of the model's answers."""
    hits, alarms = _z_rates(sample)
    return -(hits + alarms) / 2
