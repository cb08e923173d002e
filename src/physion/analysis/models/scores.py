"""The scores of one model on one set of stimuli, for the sample and all its resamples at once.

Every score is a function of weighted sums over stimuli. One matrix product of the resampling
weights with the summands gives these for a thousand resamples; sums of several scenarios add up to
those of the pool.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.statistics.agreement import CONSTANT, FEWEST
from physion.analysis.statistics.correlation import from_sums

Array = npt.NDArray[np.float64]

SCORES = (
    "accuracy",
    "accuracy_simulated",
    "human_accuracy",
    "difference",
    "r",
    "r_same",
    "rmsd",
)
"""Scores that get an interval; `scores` says what they are."""

_MOMENTS = ("x", "y", "xx", "yy", "xy")
_SUMMANDS = ("n", "correct", "correct_simulated", "human", "square", *_MOMENTS)
_SAME = ("n_same", *(f"{name}_same" for name in _MOMENTS))


def summands(rows: pd.DataFrame) -> Array:
    """What is summed over stimuli, shape (n, 16).

    ``rows`` has a row a stimulus with ``p_contact``, ``p_yes`` (NaN without people),
    ``human_accuracy``, and as bool ``predicted``, ``label`` and ``simulated``.
    """
    x = rows["p_contact"].to_numpy(dtype=np.float64) - 0.5
    y = rows["p_yes"].to_numpy(dtype=np.float64) - 0.5
    predicted = rows["predicted"].to_numpy(dtype=bool)
    label = rows["label"].to_numpy(dtype=bool)
    simulated = rows["simulated"].to_numpy(dtype=bool)
    moments = [x, y, x * x, y * y, x * y]
    plain = [
        np.ones(len(rows)),
        predicted == label,
        predicted == simulated,
        rows["human_accuracy"].to_numpy(dtype=np.float64),
        (x - y) ** 2,
        *moments,
    ]
    same = [np.where(label == simulated, value, 0.0) for value in (np.ones(len(rows)), *moments)]
    return np.stack([*plain, *same], axis=1).astype(np.float64)


def scores(sums: Array) -> dict[str, Array]:
    """Scores from sums over stimuli of shape (..., 16); each is an array of shape (...).

    - ``accuracy``: share of the model's answers that equal the official outcome;
    - ``accuracy_simulated``: that equal the outcome of the trial as the model was shown it;
    - ``human_accuracy``: mean over stimuli of the share of people who are right;
    - ``difference``: ``accuracy`` - ``human_accuracy``;
    - ``r``: Pearson's r of P(contact) with the share of people who say yes;
    - ``r_same``: the same over stimuli whose simulated outcome is the official one;
    - ``rmsd``: root of the mean squared difference of the same two.

    NaN where undefined.
    """
    total = dict(zip((*_SUMMANDS, *_SAME), np.moveaxis(sums, -1, 0), strict=True))
    with np.errstate(divide="ignore", invalid="ignore"):
        found = {
            "accuracy": total["correct"] / total["n"],
            "accuracy_simulated": total["correct_simulated"] / total["n"],
            "human_accuracy": total["human"] / total["n"],
            "difference": (total["correct"] - total["human"]) / total["n"],
            "r": from_sums(*(total[key] for key in ("n", *_MOMENTS))),
            "r_same": from_sums(*(total[key] for key in _SAME)),
            "rmsd": np.sqrt(total["square"] / total["n"]),
        }
    return found


def why_no_r(x: npt.ArrayLike, y: npt.ArrayLike) -> str:
    """In words why Pearson's r of these is undefined; empty where it is defined."""
    a, b = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    if not np.isfinite(b).all():
        return "r: no answers of people"
    if len(a) < FEWEST:
        return f"r: fewer than {FEWEST} stimuli"
    if np.std(a) < CONSTANT:
        return "r: the model's P(contact) is constant"
    return "r: people's answers are constant" if np.std(b) < CONSTANT else ""
