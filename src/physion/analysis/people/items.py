"""Statistics of single stimuli as items of a test: difficulty, and whether they measure the same.

References
----------
J. C. Nunnally and I. H. Bernstein, *Psychometric theory*, third edition, 1994, chapter 8.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.people.people import all_answers
from physion.analysis.statistics.correlation import correlate_rows

Array = npt.NDArray[np.float64]
COLUMNS = ("scenario", "stimulus", "people", "difficulty", "item_rest", "reason")


def item_statistics(test: pd.DataFrame) -> pd.DataFrame:
    """Return one row a stimulus.

    ``test``: test rows of `participants.Responses`. Columns: ``scenario``, ``stimulus``, ``people``
    (who answered it), ``difficulty`` (fraction who are right, as item analysis names it: large is
    easy), ``item_rest`` (item-rest correlation: r over people of being right at this stimulus with
    the fraction of right answers at the other stimuli of the scenario that they answered),
    ``reason``. An item-rest correlation near 0 or below says that people who do well otherwise do
    not do better at this stimulus; it is NaN if all answers are right or wrong.
    """
    parts = []
    for answers in all_answers(test):
        right = answers.correct
        given = np.isfinite(right)
        known = np.where(given, right, 0.0)
        others = given.sum(axis=1)[:, None] - given
        with np.errstate(divide="ignore", invalid="ignore"):
            rest = np.where(others > 0, (known.sum(axis=1)[:, None] - known) / others, np.nan)
        people = given.sum(axis=0)
        difficulty = known.sum(axis=0) / people
        item_rest = correlate_rows(right.T, np.where(given, rest, np.nan).T)
        parts.append(
            pd.DataFrame(
                {
                    "scenario": answers.scenario,
                    "stimulus": answers.stimuli,
                    "people": people,
                    "difficulty": difficulty,
                    "item_rest": item_rest,
                    "reason": [
                        _why(value, fraction, count)
                        for value, fraction, count in zip(
                            item_rest, difficulty, people, strict=True
                        )
                    ],
                }
            )
        )
    return pd.concat(parts, ignore_index=True)[list(COLUMNS)]


def _why(item_rest: float, difficulty: float, people: int) -> str:
    if np.isfinite(item_rest):
        return ""
    if difficulty in (0, 1):
        return (
            "item-rest correlation: all answers are right"
            if difficulty
            else ("item-rest correlation: all answers are wrong")
        )
    return f"item-rest correlation: {people} people, or all equally good elsewhere"
