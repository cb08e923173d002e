"""Answers of one scenario as arrays of participants by stimuli."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.core.errors import BadInputError

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ScenarioAnswers:
    """Answers of all participants to one scenario.

    - ``sessions`` and ``participants``: names, length n, in the order of the rows of ``yes``;
    - ``stimuli``: names, length s, sorted: the columns;
    - ``yes`` (n, s): 1, 0, or NaN if that person did not answer;
    - ``label`` (s,): 1 if agent and patient touch, else 0;
    - ``log_rt`` (n, s): natural logarithm of the response time in ms, NaN if unknown.
    """

    scenario: str
    sessions: tuple[str, ...]
    participants: tuple[str, ...]
    stimuli: tuple[str, ...]
    yes: Array
    label: Array
    log_rt: Array

    @property
    def correct(self) -> Array:
        """Correctness of the answers (n, s): 1 right, 0 wrong, NaN without an answer."""
        return np.where(np.isnan(self.yes), np.nan, self.yes == self.label)

    def p_yes(self) -> Array:
        """Return the fraction of people who say yes, by stimulus, (s,)."""
        return mean_over_people(self.yes)


def mean_over_people(values: Array, weights: npt.ArrayLike | None = None) -> Array:
    """Return the mean over people, by stimulus, of values (n, s) with gaps; NaN if nobody answered.

    With ``weights`` (resamples, n), how often each person is drawn, the shape is (resamples, s).
    """
    given = ~np.isnan(values)
    drawn = np.ones(len(values)) if weights is None else np.asarray(weights, dtype=np.float64)
    total, count = drawn @ np.where(given, values, 0.0), drawn @ given.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(count > 0, total / count, np.nan)


def difference_of_pairs(yes: Array, weights: npt.ArrayLike | None = None) -> Array:
    """Return the fraction of pairs of different people who answer a stimulus differently.

    ``yes`` (n, s) holds 1, 0 or NaN; shape (s,), or (resamples, s) with ``weights`` (resamples, n),
    how often each person is drawn. A person who is drawn twice makes no pair with themselves. NaN
    where fewer than two people answered.
    """
    said_yes, said_no = (yes == 1).astype(np.float64), (yes == 0).astype(np.float64)
    drawn = np.ones(len(yes)) if weights is None else np.asarray(weights, dtype=np.float64)
    first, second = drawn @ said_yes, drawn @ said_no
    pairs = (first + second) ** 2 - drawn**2 @ (said_yes + said_no)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(pairs > 0, 2 * first * second / pairs, np.nan)


def answers_of(test: pd.DataFrame, scenario: str) -> ScenarioAnswers:
    """Return the answers to one scenario from the test rows of `participants.Responses`.

    Raises `BadInputError` if the scenario has no answer, or a session two answers to one stimulus.
    """
    rows = test[test["scenario"] == scenario]
    if rows.empty:
        raise BadInputError(f"scenario {scenario!r} has no answer of people")
    person, people = pd.factorize(rows["session"], sort=True)
    column, stimuli = pd.factorize(rows["stimulus"], sort=True)
    shape = (len(people), len(stimuli))
    cells = person * shape[1] + column
    if len(np.unique(cells)) < len(cells):
        raise BadInputError(f"scenario {scenario!r}: a session answered one stimulus twice")

    def grid(values: npt.ArrayLike) -> Array:
        values_by_cell = np.full(shape[0] * shape[1], np.nan)
        values_by_cell[cells] = np.asarray(values, dtype=np.float64)
        return values_by_cell.reshape(shape)

    owner = rows.drop_duplicates("session").set_index("session")["participant"]
    label = rows.drop_duplicates("stimulus").set_index("stimulus")["label"]
    return ScenarioAnswers(
        scenario,
        tuple(map(str, people)),
        tuple(map(str, owner.loc[people])),
        tuple(map(str, stimuli)),
        grid(rows["yes"]),
        label.loc[stimuli].to_numpy(dtype=np.float64),
        grid(rows["log_rt"]),
    )
