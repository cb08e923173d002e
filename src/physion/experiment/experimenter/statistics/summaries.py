"""What is known of every session, kept up to date without reading all answers each time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from statistics import median
from typing import Any

from sqlalchemy import Connection, Engine, Row, select

from physion.experiment.store.sessions import (
    ACTIVE_WITHIN,
    SESSION_COLUMNS,
    Session,
    TrialCounts,
    stage_of,
)
from physion.experiment.store.tables import ANSWERS, SESSIONS
from physion.experiment.study.stimuli import PHASES
from physion.experiment.study.study import Study

STATES = {
    "finished": "Finished",
    "going": "In progress",
    "left": "Dropped out",
    "withdrawn": "Withdrawn",
    "declined": "Declined",
}
"""States of a session; who dropped out may still come back and go on."""

STAGES = {
    "consent": "Consent",
    "instructions": "Instructions",
    "familiarization": "Familiarization",
    "ready": "Start page",
    "test": "Test",
    "demographics": "Demographics",
    "feedback": "Feedback",
    "done": "Finished",
}
"""Where a session stands, in order."""

_SESSION = (*SESSION_COLUMNS, SESSIONS.c.source, SESSIONS.c.last_seen, SESSIONS.c.device)
_ANSWER = (
    "session", "phase", "trial", "stimulus", "response", "rt_ms", "frames_expected",
    "frames_shown", "frames_dropped", "visibility_changes",
)  # fmt: skip
_CHUNK = 200
"""Sessions whose answers one statement reads."""


@dataclass
class Answered:
    """Sums over the answers of a session. ``rt_ms`` and ``correct`` are of the test alone.

    Trials of both phases by how the movie was shown: ``full`` (as many frames as expected),
    ``short`` (fewer), ``over`` (more), ``unknown`` (the browser could not say); ``dropped``: with
    frames decoded and dropped; ``hidden``: while the page was hidden or shown again.
    """

    familiarization: int = 0
    test: int = 0
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
        """Answers of both phases."""
        return self.familiarization + self.test

    @property
    def accuracy(self) -> float | None:
        """Share of right test answers; None without any."""
        return self.correct / self.test if self.test else None

    @property
    def median_rt(self) -> float | None:
        """Median response time of the test in ms; None without any."""
        return median(self.rt_ms) if self.rt_ms else None

    @property
    def troubled(self) -> int:
        """Trials whose movie was not shown with all its frames, as far as known."""
        return self.short + self.over

    def add(self, answer: Row[Any], label: bool | None) -> None:
        """Counts one answer; ``label`` None: the stimulus is in the study no more."""
        correct = label is not None and (answer.response == "yes") == label
        if answer.phase == "test":
            self.test += 1
            self.correct += correct
            self.rt_ms.append(answer.rt_ms)
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
class Summary:
    """A session: its row (``facts``), where it stands, and sums over its answers."""

    facts: Mapping[str, Any]
    state: str
    stage: str
    answered: Answered


_NOTHING = Answered()


class Summaries:
    """Summaries of all sessions. `refresh` reads the rows of sessions, and the answers of those
    sessions alone that have got more of them: an answer, once stored, is never altered.
    """

    def __init__(self, study: Study, engine: Engine) -> None:
        self._engine = engine
        self._labels = labels_of(study)
        self._trials = TrialCounts(study)
        self._answered: dict[str, Answered] = {}

    def refresh(self, now: float) -> list[Summary]:
        """All sessions at the moment ``now``, in the order in which they began."""
        with self._engine.connect() as connection:
            rows = connection.execute(select(*_SESSION).order_by(SESSIONS.c.started_at)).all()
            self._read_answers(connection, rows)
        return [self._summary(row, now) for row in rows]

    def _summary(self, row: Row[Any], now: float) -> Summary:
        facts = row._asdict()
        return Summary(
            facts,
            standing_of(facts, now),
            self._stage(facts),
            self._answered.get(row.session, _NOTHING),
        )

    def _read_answers(self, connection: Connection, rows: Sequence[Row[Any]]) -> None:
        """Adds up the answers of sessions whose number of answers is not the known one."""
        scenarios = {
            row.session: row.scenario
            for row in rows
            if (row.answered_familiarization, row.answered_test) != self._counts(row.session)
        }
        columns = [ANSWERS.c[name] for name in _ANSWER]
        for part in _parts(list(scenarios)):
            chosen = select(*columns).where(ANSWERS.c.session.in_(part))
            answers = connection.execute(chosen.order_by(ANSWERS.c.session)).all()
            found = {session: Answered() for session in part}
            for answer in answers:
                label = self._labels.get((scenarios[answer.session], answer.stimulus))
                found[answer.session].add(answer, label)
            self._answered |= found

    def _counts(self, session: str) -> tuple[int, int]:
        known = self._answered.get(session, _NOTHING)
        return known.familiarization, known.test

    def _stage(self, facts: Mapping[str, Any]) -> str:
        """Where a session stands, or stood when it was withdrawn."""
        columns = {column.name: facts[column.name] for column in SESSION_COLUMNS}
        session = Session(**columns | {"withdrawn_at": None})
        # How long the phases of a preview were whose scenario is gone is not known any more.
        known = self._trials.has(session.scenario)
        trials = self._trials.of(session.scenario) if known else dict.fromkeys(PHASES, 1_000_000)
        return stage_of(session, trials)


def labels_of(study: Study) -> dict[tuple[str, str], bool]:
    """How each stimulus of each scenario ends."""
    return {(each.scenario, each.stimulus): each.label for each in study.stimuli}


def standing_of(facts: Mapping[str, Any], now: float) -> str:
    """A word of `STATES`. Who leaves before agreeing to take part has declined."""
    if facts["finished_at"] is not None:
        return "finished"
    if facts["withdrawn_at"] is not None:
        return "declined" if facts["consented_at"] is None else "withdrawn"
    return "going" if now - facts["last_seen"] <= ACTIVE_WITHIN else "left"


def _parts(names: Sequence[str]) -> Iterator[Sequence[str]]:
    for start in range(0, len(names), _CHUNK):
        yield names[start : start + _CHUNK]
