"""Choose the sessions to analyse by the values of their columns, such as ``condition=fast``."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd

from physion.analysis.people.participants import Responses
from physion.core.errors import BadInputError, UnknownNameError

COLUMNS = ("condition", "language", "recruited_by", "gender", "education", "buttons", "study")
"""Columns by which sessions can be chosen, in the table of sessions or in the trials."""


def keep_where(responses: Responses, chosen: Sequence[str]) -> Responses:
    """Return the responses of the sessions that have the given values; the others are counted.

    Parameters
    ----------
    responses
        Answers of participants.
    chosen
        Texts such as ``condition=fast``. Several of one column are alternatives; of several
        columns, a session must fit all.

    Raises
    ------
    BadInputError
        A text has no ``=``, the responses lack the column, or no session has such a value.
    UnknownNameError
        The column is not in `COLUMNS`.
    """
    wanted: dict[str, set[str]] = {}
    for text in chosen:
        column, equals, value = text.partition("=")
        if not equals:
            raise BadInputError(
                f"--where {text}: give a column and a value, such as condition=fast"
            )
        if column not in COLUMNS:
            raise UnknownNameError("column of sessions", column, COLUMNS)
        wanted.setdefault(column, set()).add(value)
    for column, values in wanted.items():
        found = _values(responses, column)
        missing = sorted(values - set(found))
        if missing:
            known = ", ".join(sorted(set(found))) or "none"
            raise BadInputError(
                f"no session has {column}={missing[0]}; the values of {column} are: {known}"
            )
        kept = set(found.index[found.isin(values)])
        responses = responses.keep_sessions(kept, f"{column} is not {' or '.join(sorted(values))}")
    return responses


def _values(responses: Responses, column: str) -> pd.Series:
    """Return the values of a column that are not empty, by session."""
    for table in (responses.sessions, responses.trials):
        if column in table:
            values = table.drop_duplicates("session").set_index("session")[column].astype(str)
            return values[values != ""]
    raise BadInputError(f"the responses have no column {column}; give the table of sessions too")
