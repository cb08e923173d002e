"""The data of a study as two tables: one row a session, one row a session and trial.

Columns, types and order are those of `physion.analysis.people.response_schema`. Sessions
stand in the order in which they began; trials by session, familiarization first, in the order in
which they were shown. Labels come from the study folder. Which sessions are never in any table, and
why, is counted (`session_rows.Sessions.left_out`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence

import pandas as pd
import pyarrow as pa
from sqlalchemy import Connection, Engine

from physion.analysis.people.response_schema import SESSION_COLUMNS, TRIAL_COLUMNS
from physion.errors import PhysionError
from physion.experiment.export.arrow_types import arrow_schema, as_frame
from physion.experiment.export.session_rows import EXPORTED_KINDS, Wanted, read_sessions
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
    """Trials and sessions as they are at one moment, as `response_schema.check_table` types them.

    Sessions without consent and of participants who withdrew are left out. Raises `PhysionError`
    for answers to stimuli that the study folder has no more.
    """
    with snapshot(engine) as connection:
        sessions = read_sessions(connection, study, Wanted(kinds, scenario, finished_only))
        parts = list(read_trials(connection, study, sessions.table))
    unknown = [name for part in parts for name in part.unknown]
    if unknown:
        raise PhysionError(
            f"{len(unknown)} answers are to stimuli that {study.folder} has no more, the first to "
            f"{unknown[0]}; bring them back into stimuli.csv"
        )
    empty = arrow_schema(TRIAL_COLUMNS).empty_table()
    trials = pa.concat_tables([empty, *(part.table for part in parts)])
    return as_frame(trials, TRIAL_COLUMNS), as_frame(sessions.table, SESSION_COLUMNS)


@contextlib.contextmanager
def snapshot(engine: Engine) -> Iterator[Connection]:
    """A connection that sees the database as it is at its first question, whoever writes."""
    with engine.connect() as connection:
        if engine.dialect.name == "postgresql":
            connection.execution_options(
                isolation_level="REPEATABLE READ", postgresql_readonly=True
            )
        with connection.begin():
            if engine.dialect.name == "postgresql":
                # Else it reads all answers for each few sessions where it has no statistics yet.
                connection.exec_driver_sql("SET LOCAL enable_seqscan = off")
            yield connection
