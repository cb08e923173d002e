"""Flags of sessions by the study's exclusion rules, computed in a background thread.

`FlagCache` runs in the statistics process. Pages show the latest available flags with the time of
their computation, and wait for new ones for at most `MAX_WAIT`.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from sqlalchemy import Engine

from physion.core.errors import PhysionError
from physion.experiment.study.study import Study

LOG = logging.getLogger(__name__)
MAX_WAIT = 2.0
"""Maximum seconds for which a page waits for flags that are being computed."""
MIN_INTERVAL = 10.0
"""Minimum seconds between the starts of two computations. After a long computation it is ten times
its duration, so that flags never take more than a tenth of one core."""


@dataclass(frozen=True)
class Flags:
    """The rules that flag each session of one kind.

    Attributes
    ----------
    rule_set
        Name of the rule set.
    rules
        Names of its rules.
    by_session
        Rules that flag a session, for flagged sessions only.
    at
        Unix time of the computation; None if there has been none yet.
    problem
        Why there are no flags, or empty.
    """

    rule_set: str
    rules: tuple[str, ...] = ()
    by_session: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    at: float | None = None
    problem: str = ""

    @property
    def are_known(self) -> bool:
        """Whether the flags have been computed successfully."""
        return self.at is not None and not self.problem

    def of(self, session: str) -> tuple[str, ...]:
        """Return the rules that flag a session."""
        return self.by_session.get(session, ())


FindFlags = Callable[[], Mapping[str, Flags]]
"""Computes the flags of all sessions, by kind of session."""


class FlagCache:
    """Cache of flags, recomputed when ``state``, a version token of the data, changes."""

    def __init__(self, find: FindFlags, rule_set: str) -> None:
        self._find, self._empty = find, Flags(rule_set)
        self._flags: Mapping[str, Flags] = {}
        self._state: object = None
        self._started, self._took = -1e9, 0.0
        self._thread: threading.Thread | None = None

    def flags(self, kind: str, state: object) -> Flags:
        """Return the flags of a kind; start a new computation if ``state`` has changed.

        ``state`` can be any value that changes with the data. The result may be of an older state
        if the new flags are not available within `MAX_WAIT`.
        """
        too_soon = time.monotonic() < self._started + max(MIN_INTERVAL, 10 * self._took)
        if state != self._state and not too_soon and not self._is_busy():
            self._started = time.monotonic()
            self._thread = threading.Thread(target=self._work, args=(state,), daemon=True)
            self._thread.start()
        if self._thread is not None:
            self._thread.join(MAX_WAIT)
        return self._flags.get(kind, self._empty)

    def _is_busy(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def _work(self, state: object) -> None:
        """Compute the flags; runs in the background thread."""
        started = time.monotonic()
        try:
            self._flags = self._find()
        except Exception as error:  # the pages continue without flags and show the error
            LOG.exception("flags could not be computed")
            problem = f"{type(error).__name__}: {error}"
            broken = replace(self._empty, at=time.time(), problem=problem)
            self._flags = {"person": broken, "simulated": broken}
        self._state = state
        self._took = time.monotonic() - started


def find_flags(study: Study, engine: Engine) -> Mapping[str, Flags]:
    """Compute the flags of people and of simulated participants, separately for each kind.

    Previews have no flags: the rules are applied to exported data, which excludes previews.
    """
    from physion.analysis.people.exclusions import RULE_SETS, RULES, flag_sessions
    from physion.analysis.people.responses import clean
    from physion.experiment.export.answer_tables import read_tables
    from physion.experiment.export.expected import expected_names

    trials, sessions = read_tables(engine, study)
    with engine.connect() as connection:
        expected = expected_names(connection, study)
    result = {"preview": Flags(study.exclusions, problem="previews are never analysed")}
    for kind, simulated in (("person", False), ("simulated", True)):
        rows = trials[trials["simulated"] == simulated]
        if not (rows["phase"] == "test").any():
            result[kind] = Flags(study.exclusions, RULES, {}, time.time())
            continue
        people = sessions[sessions["simulated"] == simulated]
        try:
            responses = clean(rows, people, where="the database")
            table = flag_sessions(responses, RULE_SETS[study.exclusions], expected=expected)
        except PhysionError as error:
            result[kind] = Flags(study.exclusions, at=time.time(), problem=str(error))
            continue
        marks = table.set_index("session")[list(RULES)]
        by_session = {
            str(session): tuple(rule for rule, on in zip(RULES, row, strict=True) if on)
            for session, row in zip(marks.index, marks.to_numpy(), strict=True)
            if row.any()
        }
        result[kind] = Flags(study.exclusions, RULES, by_session, time.time())
    return result
