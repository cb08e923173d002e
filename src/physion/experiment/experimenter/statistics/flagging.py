"""Which sessions the study's exclusion rules flag, worked out behind the pages.

`Flagger` runs in the process of `desk`, in a thread of its own: pages show the last flags there
are, with their age, and never wait for new ones longer than `PATIENCE`.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from sqlalchemy import Engine

from physion.errors import PhysionError
from physion.experiment.study.study import Study

LOG = logging.getLogger(__name__)
PATIENCE = 2.0
"""Seconds for which a page waits for flags that are being worked out."""
REST = 10.0
"""Seconds at least between the beginnings of two workings-out; after a long one, ten times its
length, so that flags never take more than a tenth of one core."""


@dataclass(frozen=True)
class Flags:
    """The rules that flag each session of one kind, and when this was found.

    ``by_session`` holds flagged sessions alone. ``problem`` says why there are no flags. ``at``
    is None where none have been worked out yet.
    """

    rule_set: str
    rules: tuple[str, ...] = ()
    by_session: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    at: float | None = None
    problem: str = ""

    @property
    def are_known(self) -> bool:
        """Were flags worked out?"""
        return self.at is not None and not self.problem

    def of(self, session: str) -> tuple[str, ...]:
        """The rules that flag a session."""
        return self.by_session.get(session, ())


Find = Callable[[], Mapping[str, Flags]]
"""Works out the flags of the sessions of each kind."""


class Flagger:
    """Keeps flags up to date. ``state`` of the data tells whether they would be other ones."""

    def __init__(self, find: Find, rule_set: str) -> None:
        self._find, self._nothing = find, Flags(rule_set)
        self._flags: Mapping[str, Flags] = {}
        self._state: object = None
        self._begun, self._took = -1e9, 0.0
        self._thread: threading.Thread | None = None

    def flags(self, kind: str, state: object) -> Flags:
        """The flags of a kind; new ones are begun where the data are in another ``state``."""
        resting = time.monotonic() < self._begun + max(REST, 10 * self._took)
        if state != self._state and not resting and not self._is_busy():
            self._begun = time.monotonic()
            self._thread = threading.Thread(target=self._work, args=(state,), daemon=True)
            self._thread.start()
        if self._thread is not None:
            self._thread.join(PATIENCE)
        return self._flags.get(kind, self._nothing)

    def _is_busy(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def _work(self, state: object) -> None:
        begun = time.monotonic()
        try:
            self._flags = self._find()
        except Exception as error:  # the pages go on without flags, and say why
            LOG.exception("flags could not be worked out")
            problem = f"{type(error).__name__}: {error}"
            broken = replace(self._nothing, at=time.time(), problem=problem)
            self._flags = {"person": broken, "simulated": broken}
        self._state = state
        self._took = time.monotonic() - begun


def find_flags(study: Study, engine: Engine) -> Mapping[str, Flags]:
    """The flags of people and of simulated participants, each among their own.

    Previews have none: they are in no export, and the rules read what the export holds.
    """
    from physion.analysis.people.exclusions import RULE_SETS, RULES, flag_sessions
    from physion.analysis.people.participants import clean
    from physion.experiment.export.answer_tables import read_tables

    trials, sessions = read_tables(engine, study)
    expected = {name.lower(): len(study.phase(name, "test")) for name in study.scenarios}
    found = {"preview": Flags(study.exclusions, problem="previews are never analysed")}
    for kind, simulated in (("person", False), ("simulated", True)):
        rows = trials[trials["simulated"] == simulated]
        if not (rows["phase"] == "test").any():
            found[kind] = Flags(study.exclusions, RULES, {}, time.time())
            continue
        people = sessions[sessions["simulated"] == simulated]
        try:
            responses = clean(rows, people, where="the database")
            table = flag_sessions(responses, RULE_SETS[study.exclusions], expected=expected)
        except PhysionError as error:
            found[kind] = Flags(study.exclusions, at=time.time(), problem=str(error))
            continue
        marks = table.set_index("session")[list(RULES)]
        by_session = {
            str(session): tuple(rule for rule, on in zip(RULES, row, strict=True) if on)
            for session, row in zip(marks.index, marks.to_numpy(), strict=True)
            if row.any()
        }
        found[kind] = Flags(study.exclusions, RULES, by_session, time.time())
    return found
