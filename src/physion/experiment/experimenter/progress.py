"""What the experimenter's pages count: sessions with their states and flags, and the progress.

All numbers are read when a page is asked for. The answers are counted by one statement in SQLite,
which holds no Python lock, so that participants are not delayed. Only the flags of the exclusion
rules, which need all answers, are kept until another session has ended.
"""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from statistics import fmean
from typing import Any

from sqlalchemy import Engine, select, text

from physion.core.errors import PhysionError
from physion.core.names import canonical_name
from physion.experiment.protocol import Course, label
from physion.experiment.store.database import SESSIONS
from physion.experiment.store.sessions import (
    ACTIVE_WITHIN,
    SESSION_COLUMNS,
    Courses,
    Session,
    end_of,
    stage_of,
    stages_of,
)
from physion.experiment.study.stimuli import PHASES
from physion.experiment.study.study import Study

KINDS = {"person": "People", "simulated": "Simulated", "preview": "Previews"}
"""Kinds of sessions and their labels."""
STATES = {
    "finished": "Finished",
    "going": "In progress",
    "left": "Dropped out",
    "withdrawn": "Withdrawn",
    "screened_out": "Screened out",
    "void": "Void",
}
"""States of a session and their labels. Participants who dropped out may still continue."""
FLAGS_SECONDS = 10.0
"""Least time in seconds between two computations of the flags."""
ALARM_ENTRIES = 30
"""People who enter within a minute from which on the pages warn."""
_COUNTS = text("""
SELECT answers.session, answers.phase,
       COUNT(*) AS answers,
       SUM((answers.response = 'yes') = (sessions.scenario || '/' || answers.stimulus IN
           (SELECT value FROM json_each(:contacts)))) AS correct,
       SUM(answers.frames_shown <> answers.frames_expected) AS incomplete
FROM answers JOIN sessions ON sessions.session = answers.session
GROUP BY answers.session, answers.phase
""")
"""Answers of each session by phase; ``contacts`` are the stimuli whose outcome is a contact."""
_UNKNOWN = dict.fromkeys(PHASES, 1_000_000)
"""Trials of previews of scenarios that the study no longer has."""


@dataclass(frozen=True)
class SessionLine:
    """One session: its row in the database, its state and stage, and its counts of answers.

    Attributes
    ----------
    row
        Columns of the table of sessions.
    state
        One of `STATES`.
    stage
        The page or phase that it has reached, as a label.
    trials, correct
        Numbers of test answers and of right ones.
    incomplete
        Trials of all phases whose movie was not displayed with all its frames.
    flags
        Exclusion rules that flag it; none while it is in progress, because they may change.
    """

    row: Any
    state: str
    stage: str
    trials: int
    correct: int
    incomplete: int
    flags: tuple[str, ...]

    @property
    def accuracy(self) -> float | None:
        """Fraction of right test answers; None without answers."""
        return self.correct / self.trials if self.trials else None

    @property
    def minutes(self) -> float:
        """Duration to the end of the session, or to its last request."""
        end = self.row.finished_at or self.row.withdrawn_at or self.row.last_seen
        return max(0.0, float(end - self.row.started_at)) / 60

    @property
    def counts(self) -> bool:
        """Whether it is finished and plausible."""
        return self.state == "finished" and self.row.implausible is None


@dataclass(frozen=True)
class Flags:
    """The exclusion rules that flag sessions of one kind.

    ``by_session`` has flagged sessions only; ``at`` is the time of the computation, None before the
    first; ``problem`` says why there are no flags, or is empty.
    """

    rule_set: str
    by_session: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    at: float | None = None
    problem: str = ""


@dataclass(frozen=True)
class ProgressRow:
    """Sessions of one scenario or condition.

    Attributes
    ----------
    name
        The scenario or condition, or ``All``.
    wanted
        Number of complete sessions wanted; 0 if it is not limited.
    states
        Number of sessions in each of `STATES`.
    counted
        Number of finished sessions that are plausible.
    flagged
        Number of flagged finished sessions.
    accuracy
        Mean accuracy of the counted sessions.
    """

    name: str
    wanted: int
    states: Mapping[str, int]
    counted: int
    flagged: int
    accuracy: float | None

    @property
    def percent(self) -> float:
        """Counted sessions in percent of the wanted ones, at most 100."""
        return min(100.0, 100.0 * self.counted / self.wanted) if self.wanted else 0.0


class StudyProgress:
    """Reads the numbers of a study; its methods are called in threads."""

    def __init__(self, study: Study, engine: Engine) -> None:
        self._study, self._engine = study, engine
        self._courses, self._stages = Courses(study), stages_of(study)
        self._contacts = json.dumps(
            [f"{scenario}/{name}" for (scenario, name), label in study.labels.items() if label]
        )
        self._flags: Mapping[str, Flags] = {}
        self._flags_of: object = None
        self._flags_due = 0.0
        self._lock = threading.Lock()

    def sessions(self, kind: str, session: str | None = None) -> tuple[list[SessionLine], Flags]:
        """Return the sessions of a kind, or only one session, latest first, and the flags."""
        chosen = SESSIONS.c.kind == kind if session is None else SESSIONS.c.session == session
        with self._engine.connect() as connection:
            rows = connection.execute(
                select(SESSIONS).where(chosen).order_by(SESSIONS.c.started_at.desc())
            ).all()
            answers: dict[str, Counter[str]] = {}
            for name, phase, count, correct, incomplete in connection.execute(
                _COUNTS, {"contacts": self._contacts}
            ):
                counter = answers.setdefault(name, Counter())
                counter["incomplete"] += incomplete or 0
                if phase == "test":
                    counter["trials"], counter["correct"] = count, correct
        if session is not None and not rows:
            return [], Flags(self._study.exclusions)
        flags, now = self.flags(rows[0].kind if session is not None else kind), time.time()
        lines = []
        for row in rows:
            state, counted = session_state(row, now), answers.get(row.session, Counter())
            lines.append(
                SessionLine(
                    row,
                    state,
                    self._stage(row._asdict()),
                    counted["trials"],
                    counted["correct"],
                    counted["incomplete"],
                    () if state == "going" else flags.by_session.get(row.session, ()),
                )
            )
        return lines, flags

    def kinds(self) -> dict[str, int]:
        """Return the number of sessions of each kind."""
        with self._engine.connect() as connection:
            counts = Counter(connection.scalars(select(SESSIONS.c.kind)))
        return {kind: counts[kind] for kind in KINDS}

    def rows(self, lines: Sequence[SessionLine]) -> tuple[list[ProgressRow], list[ProgressRow]]:
        """Return the rows by scenario, with the total if there are several, and by condition."""
        wanted = self._study.participants
        by_scenario = [
            _row(name, wanted, [s for s in lines if s.row.scenario == name])
            for name in self._study.scenarios
        ]
        if len(by_scenario) > 1:
            total = _row("All", wanted * len(by_scenario), lines)
            by_scenario.append(total)
        by_condition = [
            _row(each.name, 0, [s for s in lines if s.row.condition == each.name])
            for each in self._study.conditions
        ]
        return by_scenario, by_condition

    def flags(self, kind: str) -> Flags:
        """Return the flags of a kind of sessions; computed anew when another session has ended."""
        if kind == "preview":
            return Flags(self._study.exclusions, problem="previews are never analysed")
        columns = SESSIONS.c
        ends = (columns.finished_at, columns.withdrawn_at, columns.voided_at)
        with self._lock:
            with self._engine.connect() as connection:
                rows = connection.execute(select(*ends).where(columns.kind != "preview"))
                state = Counter(tuple(end is not None for end in row) for row in rows)
                state.pop((False, False, False), None)
            if not state:  # nobody is at the end
                return Flags(self._study.exclusions, {}, time.time())
            if state != self._flags_of and time.monotonic() >= self._flags_due:
                self._flags, self._flags_of = _find_flags(self._study, self._engine), state
                self._flags_due = time.monotonic() + FLAGS_SECONDS
            return self._flags[kind]

    def _stage(self, row: Mapping[str, Any]) -> str:
        """Return the label of the stage of a session, or of the one at which it ended early."""
        columns = {column.name: row[column.name] for column in SESSION_COLUMNS}
        session = Session(**columns | {"withdrawn_at": None, "screened_out_at": None})
        known = self._courses.has(session)
        course = self._courses.of(session) if known else Course(self._stages, _UNKNOWN)
        return label(stage_of(session, course))


def session_state(row: Any, now: float) -> str:
    """Return the state (one of `STATES`) of the row of a session at the Unix time ``now``."""
    return end_of(row) or ("going" if now - row.last_seen <= ACTIVE_WITHIN else "left")


def _row(name: str, wanted: int, part: Sequence[SessionLine]) -> ProgressRow:
    """Return the row of some sessions."""
    states = Counter(line.state for line in part)
    counted = [line for line in part if line.counts]
    accuracies = [line.accuracy for line in counted if line.accuracy is not None]
    return ProgressRow(
        name,
        wanted,
        {state: states[state] for state in STATES},
        len(counted),
        sum(line.state == "finished" and bool(line.flags) for line in part),
        fmean(accuracies) if accuracies else None,
    )


def load_analysis() -> None:
    """Import what the flags need: done when the server starts, since it takes a second."""
    import physion.analysis.people.exclusions
    import physion.analysis.people.responses
    import physion.experiment.export.tables  # noqa: F401


def _find_flags(study: Study, engine: Engine) -> Mapping[str, Flags]:
    """Compute which sessions the study's exclusion rules flag, separately for each kind."""
    from physion.analysis.people.exclusions import RULE_SETS, RULES, flag_sessions
    from physion.analysis.people.responses import clean
    from physion.experiment.export.tables import read_tables

    trials, sessions = read_tables(engine, study)
    expected = {
        name.lower(): frozenset(canonical_name(s.stimulus) for s in study.phase(name, "test"))
        for name in study.scenarios
    }
    found = {}
    for kind in ("person", "simulated"):
        now = time.time()
        rows = trials[trials["simulated"] == (kind == "simulated")]
        if not (rows["phase"] == "test").any():
            found[kind] = Flags(study.exclusions, {}, now)
            continue
        people = sessions[sessions["simulated"] == (kind == "simulated")]
        try:
            responses = clean(rows, people, where="the database")
            table = flag_sessions(responses, RULE_SETS[study.exclusions], expected=expected)
        except PhysionError as error:
            found[kind] = Flags(study.exclusions, {}, now, str(error))
            continue
        marks = table.set_index("session")[list(RULES)]
        by_session = {
            str(session): tuple(rule for rule, on in zip(RULES, row, strict=True) if on)
            for session, row in zip(marks.index, marks.to_numpy(), strict=True)
            if row.any()
        }
        found[kind] = Flags(study.exclusions, by_session, now)
    return found
