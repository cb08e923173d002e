"""The data of a study as two data frames: one row per session, one row per trial.

Columns, types and order are those of `physion.analysis.people.responses`. Sessions are sorted
by start time; trials by session, then familiarization before test, in the order in which they were
shown. Labels are read from the study folder. Sessions that are left out are counted by reason
(`session_rows.SessionTable.left_out`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import pandas as pd
import pyarrow as pa
from sqlalchemy import Connection, Engine

from physion.analysis.people.responses import SESSION_COLUMNS, TRIAL_COLUMNS
from physion.core.errors import PhysionError
from physion.experiment.export.arrow_types import arrow_schema, as_frame
from physion.experiment.export.session_rows import EXPORTED_KINDS, SessionSelection, read_sessions
from physion.experiment.export.trial_rows import read_trials
from physion.experiment.study.study import Study


def read_tables(
    engine: Engine,
    study: Study,
    *,
    kinds: Sequence[str] = EXPORTED_KINDS,
    scenario: str | None = None,
    finished_only: bool = False,
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Read trials and sessions from one consistent snapshot of the database.

    Sessions without consent and of participants who withdrew are left out.

    Parameters
    ----------
    engine
        The database.
    study
        The study, for the labels of its stimuli.
    kinds
        Kinds of sessions to include: ``person``, ``simulated`` or both.
    scenario
        Include only this scenario.
    finished_only
        Include only finished sessions.

    Returns
    -------
    tuple of DataFrame
        Trials and sessions, with the types of `response_schema.check_table`.

    Raises
    ------
    PhysionError
        There are answers to stimuli that the study folder no longer has.
    """
    with snapshot(engine) as connection:
        sessions = read_sessions(
            connection, study, SessionSelection(kinds, scenario, finished_only)
        )
        parts = list(read_trials(connection, study, sessions.table))
    unknown = [name for part in parts for name in part.unknown]
    if unknown:
        raise PhysionError(
            f"{len(unknown)} answers are to stimuli that {study.folder} no longer has, the first "
            f"to {unknown[0]}; restore them in stimuli.csv"
        )
    empty = arrow_schema(TRIAL_COLUMNS).empty_table()
    trials = pa.concat_tables([empty, *(part.table for part in parts)])
    return as_frame(trials, TRIAL_COLUMNS), as_frame(sessions.table, SESSION_COLUMNS)


@contextlib.contextmanager
def snapshot(engine: Engine) -> Iterator[Connection]:
    """Open a read connection that sees the database as of its first query, despite later writes."""
    with engine.connect() as connection, connection.begin():
        yield connection
