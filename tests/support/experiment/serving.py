"""Servers that start quickly, for crash tests, and the rows that they leave in the database."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from typing import Any

import sqlalchemy as sa

from physion.experiment.server_process import ServerProcess
from physion.experiment.store.database import ANSWERS, SESSIONS, open_database
from physion.experiment.study.study import Study

MOTHER = """
import os, sys
import sqlalchemy.dialects.sqlite, tyro
import physion.cli.experiment.serve, physion.experiment.server
from physion.experiment.experimenter.progress import load_analysis
from physion.cli.main import main
load_analysis()
while os.read(0, 1):
    child = os.fork()
    if child == 0:
        os.dup2(2, 1)
        os._exit(main(sys.argv[1:]))
    os.write(1, b"%d\\n" % child)
    os.write(1, b"%d\\n" % os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""
"""Program that imports the server's modules and forks a server for each byte on its stdin."""


class Forked:
    """A forked server, with the methods of `subprocess.Popen` that `ServerProcess` uses."""

    def __init__(self, mother: subprocess.Popen[bytes]) -> None:
        self._reports, self._code = mother.stdout, None
        os.write(mother.stdin.fileno(), b"1")
        self.pid = int(self._reports.readline())

    def poll(self, timeout: float = 0.0) -> int | None:
        if self._code is None and select.select([self._reports], [], [], timeout)[0]:
            self._code = int(self._reports.readline())
        return self._code

    def wait(self, timeout: float = 60.0) -> int:
        code = self.poll(timeout)
        if code is None:
            raise subprocess.TimeoutExpired("forked server", timeout)
        return code

    def kill(self) -> None:
        self._signal(signal.SIGKILL)

    def terminate(self) -> None:
        self._signal(signal.SIGTERM)

    def _signal(self, number: signal.Signals) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)


class QuickServer(ServerProcess):
    """`physion experiment serve` in a process forked after all imports."""

    _mother: subprocess.Popen[bytes] | None = None

    def _new_process(self) -> Any:
        if self._mother is None:
            words = [sys.executable, "-c", MOTHER, *self._command[3:]]
            self._mother = subprocess.Popen(
                words, bufsize=0, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._output
            )
        return Forked(self._mother)

    def __exit__(self, *error: Any) -> None:
        super().__exit__(*error)
        if self._mother is not None:
            self._mother.stdin.close()
            self._mother.wait(10)
            self._mother.stdout.close()


def stored_sessions(study: Study) -> dict[str, Any]:
    """Return the rows of SESSIONS by the participant's reference."""
    return {row.reference: row for row in _rows(study, sa.select(SESSIONS))}


def stored_answers(study: Study) -> dict[tuple[str, str, int], Any]:
    """Return the rows of ANSWERS by reference, phase and trial."""
    query = sa.select(ANSWERS, SESSIONS.c.reference).join(SESSIONS)
    rows = _rows(study, query)
    by_trial = {(row.reference, row.phase, row.trial): row for row in rows}
    assert len(by_trial) == len(rows)
    return by_trial


def _rows(study: Study, query: sa.Select[Any]) -> list[Any]:
    engine = open_database(study.folder)
    try:
        with engine.connect() as connection:
            return list(connection.execute(query).all())
    finally:
        engine.dispose()
