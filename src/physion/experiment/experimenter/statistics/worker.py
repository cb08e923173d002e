"""The statistics process itself: computes the content of pages on request (see `process`)."""

from __future__ import annotations

import os
import signal
import time
import traceback
from collections.abc import Callable, Mapping
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

from sqlalchemy import Engine

from physion.core.errors import PhysionError
from physion.experiment.experimenter.archive import export_archive
from physion.experiment.experimenter.overview import Overview, compute_overview
from physion.experiment.experimenter.payment_table import Performance, performances
from physion.experiment.experimenter.session_list import SessionFilter, SessionList, list_sessions
from physion.experiment.experimenter.session_page import SessionPage, read_session_page
from physion.experiment.experimenter.statistics.flagging import FlagCache, Flags, find_flags
from physion.experiment.experimenter.statistics.summaries import SessionSummary, SummaryCache
from physion.experiment.store.database import open_database
from physion.experiment.study.study import Study

CACHE_SECONDS = 3.0
"""Seconds for which summaries are reused before the database is read again."""
IDLE_TIMEOUT = 900.0
"""Seconds without a request after which the process ends, which frees its memory."""

Reply = tuple[Literal["result", "refused", "failed"], Any]
"""Reply to a request: its result, an error message, or a traceback."""


class StatisticsWorker:
    """The requests that the process answers, one method each; arguments and results are pickled."""

    def __init__(self, study: Study, engine: Engine) -> None:
        self._study, self._engine = study, engine
        self._summaries = SummaryCache(study, engine)
        self._flagger = FlagCache(lambda: find_flags(study, engine), study.exclusions)
        self._read: list[SessionSummary] = []
        self._read_at = -CACHE_SECONDS

    def overview(self, kind: str) -> tuple[Overview, Flags]:
        """Compute the overview of the sessions of a kind; return it with the flags it counts."""
        summaries = self._refresh()
        flags = self._flags(kind)
        return compute_overview(self._study, summaries, flags, time.time(), kind), flags

    def sessions(self, choice: SessionFilter) -> tuple[SessionList, Flags]:
        """Return a page of the table of sessions, and the flags."""
        summaries = self._refresh()
        flags = self._flags(choice.kind)
        return list_sessions(summaries, flags, choice), flags

    def session(self, session: str) -> SessionPage | None:
        """Return the content of the page of one session, or None if it does not exist."""
        summaries = self._refresh()
        if not any(summary.facts["session"] == session for summary in summaries):
            summaries = self._refresh(max_age=0.0)  # it may be newer than the cached summaries
        kinds = {str(s.facts["session"]): str(s.facts["kind"]) for s in summaries}
        flags = self._flags(kinds.get(session, ""))
        return read_session_page(self._study, self._engine, summaries, flags, session)

    def payments(self) -> dict[str, Performance]:
        """Return the performance in each session of a person."""
        return performances(self._refresh(), self._flags("person"))

    def export(self, folder: Path, simulated: bool) -> Path:
        """Write the export into ``folder``; return the path of its zip file."""
        return export_archive(self._study, self._engine, folder, simulated)

    def _refresh(self, max_age: float = CACHE_SECONDS) -> list[SessionSummary]:
        """Return the summaries, read again if they are older than ``max_age`` seconds."""
        if time.monotonic() - self._read_at > max_age:
            self._read = self._summaries.refresh(time.time())
            self._read_at = time.monotonic()
        return self._read

    def _flags(self, kind: str) -> Flags:
        # These counts are a version token of the data that the rules use: sessions do not change
        # after their end, but withdrawn and void ones are excluded.
        ended = sum(s.facts["finished_at"] is not None for s in self._read)
        withdrawn = sum(s.facts["withdrawn_at"] is not None for s in self._read)
        void = sum(s.facts["voided_at"] is not None for s in self._read)
        trials = sum(s.answered.trials for s in self._read)
        return self._flagger.flags(kind, (len(self._read), trials, ended, withdrawn, void))


def serve_questions(study: Study, url: str, connection: Connection) -> None:
    """Answer requests ``(question, arguments)`` until the server ends or `IDLE_TIMEOUT`.

    The process runs at low priority, so that it does not slow down the server.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(10)
    worker = StatisticsWorker(study, open_database(url))
    while connection.poll(IDLE_TIMEOUT):
        try:
            question, arguments = connection.recv()
        except EOFError:
            return
        connection.send(_reply(worker, question, arguments))


def _reply(worker: StatisticsWorker, question: str, arguments: Mapping[str, Any]) -> Reply:
    """Call the requested method; return its result or error."""
    questions: dict[str, Callable[..., Any]] = {
        "overview": worker.overview,
        "sessions": worker.sessions,
        "session": worker.session,
        "payments": worker.payments,
        "export": worker.export,
    }
    try:
        return "result", questions[question](**arguments)
    except PhysionError as error:
        return "refused", str(error)
    except Exception:  # the process continues: other requests may succeed
        return "failed", traceback.format_exc()
