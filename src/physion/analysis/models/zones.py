"""Human zones: the range of the same measures among people, to compare models with."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.people.answers import ScenarioAnswers, mean_over_people
from physion.analysis.statistics.agreement import rmsd
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.statistics.correlation import correlate_rows
from physion.analysis.statistics.kappa import cross_kappa
from physion.analysis.tables.stimuli import MEAN
from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]

RELEASED_R = "halves, mean of scenarios (the paper's band)"
"""Name in ``of`` for the paper's grey band of r; see `released_r_zone`."""


def human_zones(answers: ScenarioAnswers, halves: Array | None = None) -> pd.DataFrame:
    """Return the range of each measure among single people.

    Columns: ``scenario``, ``measure``, ``of``, ``values`` (their number), ``mean``, ``low``,
    ``median``, ``high`` (2.5th, 50th, 97.5th percentile), ``undefined``.

    ``of`` names whose values they are: ``participants`` (each with the average of the others, or
    the mean kappa with the others: what a model must reach to be indistinguishable from a
    participant), ``pairs`` (kappa of two people, comparable to a model's kappa with single people)
    and ``halves`` (r of two halves of the people; ``halves`` is from `people.split_halves`). A
    person answers 0 or 1 and no probability, which makes r and RMSD worse; halves are averages and
    reach better values.
    """
    yes, n = answers.yes, len(answers.sessions)
    others = mean_over_people(yes, 1 - np.eye(n))
    right = answers.correct
    kappa, errors = cross_kappa(yes, yes), cross_kappa(right, right)
    for matrix in (kappa, errors):
        np.fill_diagonal(matrix, np.nan)
    distances = [rmsd_of(first, second) for first, second in zip(yes, others, strict=True)]
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
            {"scenario": answers.scenario, "measure": measure, "of": of, **_zone(values)}
            for measure, of, values in ranges
        ]
    )


def rmsd_of(first: Array, second: Array) -> float:
    """Return the RMSD of two vectors where both are finite."""
    known = np.isfinite(first) & np.isfinite(second)
    return rmsd(first[known], second[known])


def _zone(values: npt.ArrayLike) -> dict[str, float]:
    array = np.asarray(values, dtype=np.float64)
    known = array[np.isfinite(array)]
    low, median, high = np.percentile(known, [2.5, 50, 97.5]) if len(known) else [np.nan] * 3
    return {"values": len(array), "mean": float(np.mean(known)) if len(known) else np.nan,
            "low": float(low), "median": float(median), "high": float(high),
            "undefined": len(array) - len(known)}  # fmt: skip


def released_zone(
    scenario_values: Sequence[float], bootstrap: Bootstrap | None = None
) -> tuple[float, float, float]:
    """Return the grey band of the published panels for accuracy and kappa: mean, low, high.

    It is a bootstrap over the values of the eight scenarios. It shows how far their mean would vary
    with other scenarios, and not how participants differ, so it is no human zone, although the
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
