"""Summaries of all sessions, updated incrementally: only new answers are read from the database."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

from sqlalchemy import Connection, Engine, Row, select

from physion.experiment.protocol import OF_BLOCK, Block, Course, SessionTrials
from physion.experiment.store.database import ANSWERS, SESSIONS
from physion.experiment.store.sessions import (
    ACTIVE_WITHIN,
    SESSION_COLUMNS,
    Courses,
    Session,
    stage_of,
    stages_of,
)
from physion.experiment.study.orders import stimuli_by_session
from physion.experiment.study.stimuli import ATTENTION
from physion.experiment.study.study import Study

STATES = {
    "finished": "Finished",
    "going": "In progress",
    "left": "Dropped out",
    "withdrawn": "Withdrawn",
    "declined": "Declined",
    "screened_out": "Screened out",
    "void": "Void",
}
"""States of a session and their labels. Participants who dropped out may still continue."""

_SESSION = (*SESSION_COLUMNS, SESSIONS.c.source, SESSIONS.c.last_seen, SESSIONS.c.device)
_ANSWER = (
    "session", "phase", "trial", "stimulus", "response", "rt_ms", "frames_expected",
    "frames_shown", "frames_dropped", "visibility_changes",
)  # fmt: skip
_CHUNK = 200
"""Number of sessions whose answers are read in one query."""


@dataclass
class AnswerCounts:
    """Counts over the answers of a session.

    Attributes
    ----------
    familiarization, test, attention
        Number of answers in each phase, without the attention checks, and to these.
    familiarization_correct, correct
        Number of right answers in familiarization and in the test.
    rt_ms
        Response times of the test in ms.
    full, short, over, unknown
        Trials of both phases whose movie was displayed with as many frames as expected, fewer,
        more, or an unknown number (not reported by the browser).
    dropped
        Trials in which the browser dropped decoded frames.
    hidden
        Trials during which the page was hidden or shown again.
    """

    familiarization: int = 0
    test: int = 0
    attention: int = 0
    familiarization_correct: int = 0
    correct: int = 0
    rt_ms: list[float] = field(default_factory=list)
    full: int = 0
    short: int = 0
    over: int = 0
    unknown: int = 0
    dropped: int = 0
    hidden: int = 0

    @property
    def trials(self) -> int:
        """Number of answers in both phases, with attention checks."""
        return self.familiarization + self.test + self.attention

    @property
    def accuracy(self) -> float | None:
        """Fraction of right test answers; None without answers."""
        return self.correct / self.test if self.test else None

    @property
    def median_rt(self) -> float | None:
        """Median response time of the test in ms; None without answers."""
        return median(self.rt_ms) if self.rt_ms else None

    @property
    def incomplete(self) -> int:
        """Number of trials whose movie was displayed with too few or too many frames."""
        return self.short + self.over

    def add(self, answer: Row[Any], label: bool | None) -> None:
        """Add one answer; ``label`` is None if its stimulus is no longer in the study."""
        correct = label is not None and (answer.response == "yes") == label
        if answer.phase == "test":
            self.test += 1
            self.correct += correct
            self.rt_ms.append(answer.rt_ms)
        elif answer.phase == ATTENTION:
            self.attention += 1
        else:
            self.familiarization += 1
            self.familiarization_correct += correct
        shown = answer.frames_shown
        if shown is None:
            self.unknown += 1
        elif shown == answer.frames_expected:
            self.full += 1
        elif shown < answer.frames_expected:
            self.short += 1
        else:
            self.over += 1
        self.dropped += bool(answer.frames_dropped)
        self.hidden += bool(answer.visibility_changes)


@dataclass
class SessionSummary:
    """Summary of a session: its database row (``facts``), state, stage and answer counts.

    In a session of several blocks, some stages have the number of the block from 1: ``test 2``.
    """

    facts: Mapping[str, Any]
    state: str
    stage: str
    answered: AnswerCounts


_NOTHING = AnswerCounts()
_UNKNOWN = SessionTrials((Block("", range(1_000_000), range(1_000_000)),))
"""Trials of previews of scenarios that were removed."""


class SummaryCache:
    """Cache of the summaries of all sessions.

    `refresh` reads the rows of all sessions, but answers only of sessions with new ones. This is
    sufficient because stored answers are never changed.
    """

    def __init__(self, study: Study, engine: Engine) -> None:
        self._engine = engine
        self._stimuli = stimuli_by_session(study)
        self._courses, self._stages = Courses(study), stages_of(study)
        self._answered: dict[str, AnswerCounts] = {}

    def refresh(self, now: float) -> list[SessionSummary]:
        """Return the summaries of all sessions at the Unix time ``now``, sorted by start time."""
        with self._engine.connect() as connection:
            rows = connection.execute(select(*_SESSION).order_by(SESSIONS.c.started_at)).all()
            self._read_answers(connection, rows)
        return [self._summary(row, now) for row in rows]

    def _summary(self, row: Row[Any], now: float) -> SessionSummary:
        """Return the summary of one session from its database row."""
        facts = row._asdict()
        return SessionSummary(
            facts,
            session_state(facts, now),
            self._stage(facts),
            self._answered.get(row.session, _NOTHING),
        )

    def _read_answers(self, connection: Connection, rows: Sequence[Row[Any]]) -> None:
        """Count the answers of the sessions whose number of answers has changed."""
        scenarios = {
            row.session: row.scenario
            for row in rows
            if (row.answered_familiarization, row.answered_test) != self._counts(row.session)
        }
        columns = [ANSWERS.c[name] for name in _ANSWER]
        for part in _parts(list(scenarios)):
            chosen = select(*columns).where(ANSWERS.c.session.in_(part))
            answers = connection.execute(chosen.order_by(ANSWERS.c.session)).all()
            counts = {session: AnswerCounts() for session in part}
            for answer in answers:
                stimulus = self._stimuli.get((scenarios[answer.session], answer.stimulus))
                counts[answer.session].add(answer, stimulus.label if stimulus else None)
            self._answered |= counts

    def _counts(self, session: str) -> tuple[int, int]:
        known = self._answered.get(session, _NOTHING)
        return known.familiarization, known.test + known.attention

    def _stage(self, facts: Mapping[str, Any]) -> str:
        """Return the stage of a session, or the stage at which it was withdrawn."""
        columns = {column.name: facts[column.name] for column in SESSION_COLUMNS}
        session = Session(**columns | {"withdrawn_at": None, "screened_out_at": None})
        # The number of trials is unknown for previews of scenarios that were removed.
        known = self._courses.has(session)
        course = self._courses.of(session) if known else Course(self._stages, _UNKNOWN)
        stage = stage_of(session, course)
        several = len(course.trials.blocks) > 1 and stage in OF_BLOCK
        return f"{stage} {session.block + 1}" if several else stage


def stages_shown(study: Study) -> list[str]:
    """Return the stages of the sessions of a study in order, as in `SessionSummary`."""
    stages = stages_of(study)
    if not study.blocks.all_scenarios:
        return list(stages)
    of_block = [stage for stage in stages if stage in OF_BLOCK]
    shown = [f"{stage} {n}" for n in range(1, len(study.scenarios) + 1) for stage in of_block]
    before = stages.index(of_block[0])
    return [*stages[:before], *shown[:-1], *stages[before + len(of_block) :]]


def session_state(facts: Mapping[str, Any], now: float) -> str:
    """Return the state (one of `STATES`) of a session at the Unix time ``now``.

    A participant who withdraws before giving consent has declined.
    """
    if facts["voided_at"] is not None:
        return "void"
    if facts["finished_at"] is not None:
        return "finished"
    if facts["withdrawn_at"] is not None:
        return "declined" if facts["consented_at"] is None else "withdrawn"
    if facts["screened_out_at"] is not None:
        return "screened_out"
    return "going" if now - facts["last_seen"] <= ACTIVE_WITHIN else "left"


def _parts(names: Sequence[str]) -> Iterator[Sequence[str]]:
    for start in range(0, len(names), _CHUNK):
        yield names[start : start + _CHUNK]
