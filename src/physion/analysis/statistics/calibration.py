"""Calibration of P(contact): Brier score, its decomposition, and the reliability curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]

BINS = 10


def brier(p: npt.ArrayLike, label: npt.ArrayLike) -> float:
    """Return the mean squared difference of probability and outcome, 0 (perfect) to 1.

    A constant P of 0.5 has 0.25; NaN for empty arrays.
    """
    values, truth = _checked(p, label)
    return float(np.mean((values - truth) ** 2)) if len(values) else float("nan")


@dataclass(frozen=True)
class Decomposition:
    """Decomposition of the Brier score: reliability - resolution + uncertainty + within.

    - ``reliability``: mean squared distance of a bin's fraction of contact from its mean P: 0 is
      best;
    - ``resolution``: variance of the bins' fractions of contact: large is good;
    - ``uncertainty``: base rate times one minus base rate, independent of the model;
    - ``within``: remainder of bins with more than one value of P (Stephenson and others, 2008:
      variance of P within bins less twice its covariance with the outcome); 0 if every bin has one
      value;
    - ``skill``: 1 - brier / uncertainty, above 0 if the model is better than the base rate; NaN for
      one outcome alone;
    - ``calibration_error``: mean distance (not squared) of fraction and mean P, weighted by bin
      size.
    """

    brier: float
    reliability: float
    resolution: float
    uncertainty: float
    within: float
    skill: float
    calibration_error: float
    reason: str


def decompose(p: npt.ArrayLike, label: npt.ArrayLike, bins: int = BINS) -> Decomposition:
    """Return the Brier score and its parts, with ``bins`` of equal width (`reliability_curve`)."""
    values, truth = _checked(p, label)
    if not len(values):
        nan = float("nan")
        return Decomposition(nan, nan, nan, nan, nan, nan, nan, "no stimulus")
    bin_of = _bin(values, bins)
    n = np.bincount(bin_of, minlength=bins).astype(np.float64)
    full = n > 0
    mean_p = np.bincount(bin_of, values, bins)[full] / n[full]
    fraction = np.bincount(bin_of, truth, bins)[full] / n[full]
    weight, base = n[full] / len(values), float(np.mean(truth))
    index = np.cumsum(full)[bin_of] - 1
    off_p, off_y = values - mean_p[index], truth - fraction[index]
    score, uncertainty = brier(values, truth), base * (1 - base)
    one = uncertainty == 0
    return Decomposition(
        brier=score,
        reliability=float(np.sum(weight * (mean_p - fraction) ** 2)),
        resolution=float(np.sum(weight * (fraction - base) ** 2)),
        uncertainty=uncertainty,
        within=float(np.mean(off_p**2) - 2 * np.mean(off_p * off_y)),
        skill=float("nan") if one else 1 - score / uncertainty,
        calibration_error=float(np.sum(weight * np.abs(mean_p - fraction))),
        reason="skill: all stimuli have one outcome" if one else "",
    )


def reliability_curve(
    p: npt.ArrayLike, label: npt.ArrayLike, bins: int = BINS, level: float = 0.95
) -> pd.DataFrame:
    """Return one row for each bin of equal width in 0..1, including empty ones.

    Columns: ``from``, ``to`` (the last bin includes 1), ``stimuli``, ``mean_p``, ``share``
    (fraction of stimuli with contact) with ``low``, ``high`` (Wilson's interval); NaN in empty
    bins.
    """
    values, truth = _checked(p, label)
    bin_of = _bin(values, bins)
    n = np.bincount(bin_of, minlength=bins).astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean_p, fraction = (
            np.bincount(bin_of, values, bins) / n,
            np.bincount(bin_of, truth, bins) / n,
        )
        z = float(stats.norm.ppf(0.5 + level / 2))
        centre = (fraction + z * z / (2 * n)) / (1 + z * z / n)
        half = z / (1 + z * z / n) * np.sqrt(fraction * (1 - fraction) / n + (z / (2 * n)) ** 2)
    edges = np.linspace(0, 1, bins + 1)
    return pd.DataFrame(
        {
            "from": edges[:-1],
            "to": edges[1:],
            "stimuli": n.astype(int),
            "mean_p": mean_p,
            "share": fraction,
            "low": centre - half,
            "high": centre + half,
        }
    )


def calibration_table(
    names: list[str], p_contact: npt.ArrayLike, label: npt.ArrayLike, bins: int = BINS
) -> pd.DataFrame:
    """Apply `decompose` to each model: ``p_contact`` (m, s), NaN for stimuli that a model lacks."""
    values, truth = np.asarray(p_contact, np.float64), np.asarray(label, np.float64)
    rows = []
    for name, p_of_model in zip(names, values, strict=True):
        known = ~np.isnan(p_of_model)
        parts = decompose(p_of_model[known], truth[known], bins)
        rows.append({"model": name, "stimuli": int(known.sum()), **vars(parts)})
    return pd.DataFrame(rows)


def _bin(values: Array, bins: int) -> npt.NDArray[np.intp]:
    if bins < 1:
        raise BadInputError(f"{bins} bins: at least 1 is needed")
    return np.minimum((values * bins).astype(np.intp), bins - 1)


def _checked(p: npt.ArrayLike, label: npt.ArrayLike) -> tuple[Array, Array]:
    values, truth = np.asarray(p, dtype=np.float64), np.asarray(label, dtype=np.float64)
    if values.shape != truth.shape or values.ndim != 1:
        raise BadInputError(f"{values.shape} probabilities and {truth.shape} outcomes do not pair")
    check_probabilities(values)
    if not np.isin(truth, (0, 1)).all():
        raise BadInputError("outcomes must be 0 or 1")
    return values, truth


def check_probabilities(p: npt.ArrayLike, gaps: bool = False) -> None:
    """Raise `BadInputError` with the first value outside 0..1 (``gaps``: NaN is allowed)."""
    values = np.asarray(p, dtype=np.float64)
    good = (values >= 0) & (values <= 1) | (np.isnan(values) & gaps)
    if not good.all():
        index = tuple(int(i) for i in np.argwhere(~good)[0])
        raise BadInputError(f"probability {values[index]} at {index} does not lie in 0..1")
