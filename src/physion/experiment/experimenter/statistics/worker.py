"""Answers the questions of the pages, in a process of its own (`desk`)."""

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

from physion.errors import PhysionError
from physion.experiment.experimenter.archive import export_archive
from physion.experiment.experimenter.overview import Overview, look_over
from physion.experiment.experimenter.session_list import Choice, SessionList, list_sessions
from physion.experiment.experimenter.session_page import SessionPage, read_session_page
from physion.experiment.experimenter.statistics.flagging import Flagger, Flags, find_flags
from physion.experiment.experimenter.statistics.summaries import Summaries, Summary
from physion.experiment.store.database import open_database
from physion.experiment.study.study import Study

FRESH = 3.0
"""Seconds for which what was read is shown again."""
IDLE = 900.0
"""Seconds without a question after which the process ends and gives its memory back."""

Outcome = tuple[Literal["found", "refused", "failed"], Any]
"""What was asked for, why not (a sentence), or a traceback."""


class Clerk:
    """One method a question; all arguments and answers can be pickled."""

    def __init__(self, study: Study, engine: Engine) -> None:
        self._study, self._engine = study, engine
        self._summaries = Summaries(study, engine)
        self._flagger = Flagger(lambda: find_flags(study, engine), study.exclusions)
        self._read: list[Summary] = []
        self._read_at = -FRESH

    def overview(self, kind: str) -> tuple[Overview, Flags]:
        """The overview of the sessions of a kind, and the flags that it counts."""
        summaries = self._look()
        flags = self._flags(kind)
        return look_over(self._study, summaries, flags, time.time(), kind), flags

    def sessions(self, choice: Choice) -> tuple[SessionList, Flags]:
        """A page of the table of sessions."""
        summaries = self._look()
        flags = self._flags(choice.kind)
        return list_sessions(summaries, flags, choice), flags

    def session(self, session: str) -> SessionPage | None:
        """All about one session; None where there is none of that name."""
        summaries = self._look()
        if not any(summary.facts["session"] == session for summary in summaries):
            summaries = self._look(fresh=0.0)  # it may have begun just now
        kinds = {str(s.facts["session"]): str(s.facts["kind"]) for s in summaries}
        flags = self._flags(kinds.get(session, ""))
        return read_session_page(self._study, self._engine, summaries, flags, session)

    def export(self, folder: Path, simulated: bool) -> Path:
        """Writes the export into ``folder`` and gives its zip file."""
        return export_archive(self._study, self._engine, folder, simulated)

    def _look(self, fresh: float = FRESH) -> list[Summary]:
        if time.monotonic() - self._read_at > fresh:
            self._read = self._summaries.refresh(time.time())
            self._read_at = time.monotonic()
        return self._read

    def _flags(self, kind: str) -> Flags:
        # Sessions change no more once they have ended, but leave the rules' tables by withdrawing.
        ended = sum(s.facts["finished_at"] is not None for s in self._read)
        withdrawn = sum(s.facts["withdrawn_at"] is not None for s in self._read)
        trials = sum(s.answered.trials for s in self._read)
        return self._flagger.flags(kind, (len(self._read), trials, ended, withdrawn))


def serve_questions(study: Study, url: str, connection: Connection) -> None:
    """What the process does: answers ``(question, arguments)`` until the server is gone.

    It steps back behind everything else on the machine, so that participants do not wait for it.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(os, "nice"):
        os.nice(10)
    clerk = Clerk(study, open_database(url))
    while connection.poll(IDLE):
        try:
            question, arguments = connection.recv()
        except EOFError:
            return
        connection.send(_outcome(clerk, question, arguments))


def _outcome(clerk: Clerk, question: str, arguments: Mapping[str, Any]) -> Outcome:
    questions: dict[str, Callable[..., Any]] = {
        "overview": clerk.overview,
        "sessions": clerk.sessions,
        "session": clerk.session,
        "export": clerk.export,
    }
    try:
        return "found", questions[question](**arguments)
    except PhysionError as error:
        return "refused", str(error)
    except Exception:  # the next question may go well: the process stays
        return "failed", traceback.format_exc()
