"""Difficulty of stimuli for people: below chance, hard, at chance, easy."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import stats

from physion.analysis.people.answers import mean_over_people
from physion.analysis.people.people import split_halves
from physion.analysis.statistics.correlation import correlate_rows
from physion.analysis.statistics.paired import benjamini_hochberg
from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]

THIRDS = ("hard", "chance", "easy")
EDGES = (1 / 3, 2 / 3)
"""Accuracies that separate the three; 33 and 67 % in the paper."""


def below_chance_level_released(
    accuracy: npt.ArrayLike, count: npt.ArrayLike
) -> npt.NDArray[np.bool_]:
    """Return whether accuracy + 1.96 standard errors is below 0.5: the study's rule.

    The standard error is that of the normal approximation at the observed fraction, which is 0 for
    a fraction of 0; there is no correction for testing 150 stimuli.
    """
    p, n = _fractions(accuracy, count)
    return np.asarray(p + 1.96 * np.sqrt(p * (1 - p) / n) < 0.5)


def below_chance_level_p(accuracy: npt.ArrayLike, count: npt.ArrayLike) -> Array:
    """Return the exact binomial p of at most so many right answers of ``count`` by guessing."""
    p, n = _fractions(accuracy, count)
    return np.asarray(stats.binom.cdf(np.rint(p * n), n, 0.5), dtype=np.float64)


def below_chance_level(by_stimulus: pd.DataFrame, level: float = 0.05) -> pd.DataFrame:
    """Find the stimuli that people get wrong more often than by guessing, by two rules.

    ``by_stimulus`` has ``stimulus``, ``scenario``, ``accuracy`` and ``count``, from
    `people.accuracy_by_stimulus` or `responses.read_humans`. Added columns: ``released``
    (`below_chance_level_released`), ``p`` (`below_chance_level_p`), ``p_adjusted`` (Benjamini and
    Hochberg over all rows given), ``exact`` (p_adjusted < ``level``).
    """
    p = below_chance_level_p(by_stimulus["accuracy"], by_stimulus["count"])
    adjusted = benjamini_hochberg(p)
    return by_stimulus[["scenario", "stimulus", "accuracy", "count"]].assign(
        released=below_chance_level_released(by_stimulus["accuracy"], by_stimulus["count"]),
        p=p,
        p_adjusted=adjusted,
        exact=adjusted < level,
    )


def difficulty_third(accuracy: npt.ArrayLike, edges: tuple[float, float] = EDGES) -> pd.Series:
    """Return ``hard`` up to the first edge, ``easy`` from the second, ``chance`` between; NaN stays
    NaN.
    """
    values = np.asarray(accuracy, dtype=np.float64)
    names = np.select([values <= edges[0], values >= edges[1]], ["hard", "easy"], "chance")
    return pd.Series(names, dtype=object).where(np.isfinite(values), np.nan)


def r_by_third(
    p_contact: npt.ArrayLike, yes: npt.ArrayLike, label: npt.ArrayLike, halves: int = 200,
    seed: int = 0,
) -> pd.DataFrame:  # fmt: skip
    """Return r of models with the average person within hard, chance and easy stimuli of one
    scenario.

    Parameters
    ----------
    p_contact
        (m, s), NaN if a model does not predict a stimulus.
    yes
        (n, s): answers of people.
    label
        (s,): official outcomes.
    halves, seed
        Number of random splits of the people, and their seed.

    Returns
    -------
    ``third``, ``stimuli``, ``model`` (row index; -1: the two halves of the people, whose ``low``
    and ``high`` are the 2.5th and 97.5th percentile of r), ``r`` (halves: mean), ``low``, ``high``;
    NaN if r is undefined.

    Notes
    -----
    The thirds depend on the same answers as r: within a third accuracy hardly varies, so r there
    mostly tells whether P(contact) follows the outcome (easy) or its opposite (hard).
    """
    answers, truth = np.asarray(yes, np.float64), np.asarray(label, np.float64)
    models = np.atleast_2d(np.asarray(p_contact, np.float64))
    p_yes = mean_over_people(answers)
    third = difficulty_third(np.where(truth == 1, p_yes, 1 - p_yes)).to_numpy()
    rows: list[tuple[str, int, int, float, float, float]] = []
    for name in THIRDS:
        members = np.flatnonzero(third == name)
        r = correlate_rows(
            models[:, members], np.broadcast_to(p_yes[members], (len(models), len(members)))
        )
        rows += [(name, len(members), k, float(value), np.nan, np.nan) for k, value in enumerate(r)]
        among = split_halves(answers[:, members], halves, seed) if len(members) else np.empty(0)
        among = among[np.isfinite(among)]
        low, high = np.percentile(among, [2.5, 97.5]) if len(among) else (np.nan, np.nan)
        mean = float(np.mean(among)) if len(among) else np.nan
        rows.append((name, len(members), -1, mean, float(low), float(high)))
    return pd.DataFrame(rows, columns=["third", "stimuli", "model", "r", "low", "high"])


def _fractions(accuracy: npt.ArrayLike, count: npt.ArrayLike) -> tuple[Array, Array]:
    p, n = np.asarray(accuracy, dtype=np.float64), np.asarray(count, dtype=np.float64)
    if not ((p >= 0) & (p <= 1)).all() or not (n >= 1).all():
        raise BadInputError("accuracies must lie in 0..1, with at least one person a stimulus")
    return p, n
