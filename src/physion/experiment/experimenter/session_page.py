"""Content of the page of one session: everything stored about it except the raw id."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Engine, select

from physion.experiment.experimenter.session_list import flags_shown
from physion.experiment.experimenter.statistics.flagging import Flags
from physion.experiment.experimenter.statistics.summaries import SessionSummary
from physion.experiment.store.database import ANSWERS, EVENTS, SESSIONS, STUDIES
from physion.experiment.study.orders import instructed_response, stimuli_by_session
from physion.experiment.study.study import Study

EVENTS_SHOWN = 500
"""Maximum number of events shown on the page of a session."""


@dataclass(frozen=True)
class AnswerLine:
    """One answer; ``label`` is None if its stimulus is no longer in the study."""

    phase: str
    trial: int
    stimulus: str
    response: str
    label: bool | None
    rt_ms: float
    input: str
    frames_shown: int | None
    frames_expected: int
    frames_dropped: int | None
    hidden: int | None
    resumed: bool
    showings: int | None
    void: str | None
    answered_at: float

    @property
    def correct(self) -> bool | None:
        """Whether the answer is right; None if the label is unknown."""
        return None if self.label is None else (self.response == "yes") == self.label


@dataclass(frozen=True)
class EventLine:
    """One browser event; ``data`` is JSON text."""

    kind: str
    at_ms: float
    stored_at: float
    data: str


@dataclass(frozen=True)
class SessionPage:
    """Content of the page of a session.

    ``row`` has the columns of the table of sessions; ``others`` are further sessions of the same
    person as (session, scenario, state).
    """

    row: Mapping[str, Any]
    summary: SessionSummary
    flags: tuple[str, ...]
    study: str
    answers: tuple[AnswerLine, ...]
    events: tuple[EventLine, ...]
    events_left_out: int
    others: tuple[tuple[str, str, str], ...]

    @property
    def own_answers(self) -> list[tuple[str, str]]:
        """Answers to the lab's own questions, by name; empty texts where none was given."""
        given: Mapping[str, Any] = self.row["own_answers"] or {}
        return [
            (name, ", ".join(answer) if isinstance(answer, list) else str(answer or ""))
            for name, answer in given.items()
        ]


def read_session_page(
    study: Study, engine: Engine, summaries: Sequence[SessionSummary], flags: Flags, session: str
) -> SessionPage | None:
    """Read the content of the page of a session.

    Parameters
    ----------
    study
        The study.
    engine
        The database.
    summaries
        Summaries of all sessions.
    flags
        Flags of the sessions of this kind.
    session
        Identifier of the session.

    Returns
    -------
    SessionPage or None
        None if there is no such session.
    """
    summary = next((s for s in summaries if s.facts["session"] == session), None)
    if summary is None:
        return None
    with engine.connect() as connection:
        row = connection.execute(select(SESSIONS).where(SESSIONS.c.session == session)).one()
        facts = connection.execute(select(STUDIES).where(STUDIES.c.digest == row.study)).first()
        answers = _answers(study, connection, session, row.scenario)
        events = _events(connection, session)
    others = tuple(
        (str(s.facts["session"]), str(s.facts["scenario"]), s.state)
        for s in summaries
        if s.facts["participant"] == row.participant and s is not summary
    )
    return SessionPage(
        row._asdict(), summary, flags_shown(summary, flags),
        f"{facts.name} {facts.version}" if facts else "", answers,
        events[:EVENTS_SHOWN], max(0, len(events) - EVENTS_SHOWN), others,
    )  # fmt: skip


def _answers(
    study: Study, connection: Connection, session: str, scenario: str
) -> tuple[AnswerLine, ...]:
    """Read the answers of a session in order."""
    labels = {key: each.label for key, each in stimuli_by_session(study).items()}

    def label_of(stimulus: str) -> bool | None:
        asked = instructed_response(stimulus)
        return labels.get((scenario, stimulus)) if asked is None else asked == "yes"

    table = ANSWERS.c
    rows = connection.execute(
        select(*(column for column in table if column.name != "details"))
        .where(table.session == session)
        .order_by(table.phase, table.trial)
    )
    return tuple(
        AnswerLine(
            row.phase, row.trial, row.stimulus, row.response, label_of(row.stimulus),
            row.rt_ms, row.input, row.frames_shown, row.frames_expected, row.frames_dropped,
            row.visibility_changes, row.resumed, row.showings, row.void, row.answered_at,
        )
        for row in rows
    )  # fmt: skip


def _events(connection: Connection, session: str) -> tuple[EventLine, ...]:
    """Read the events of a session in order."""
    rows = connection.execute(
        select(EVENTS).where(EVENTS.c.session == session).order_by(EVENTS.c.event)
    )
    return tuple(
        EventLine(row.kind, row.at_ms, row.stored_at, json.dumps(row.data, ensure_ascii=False))
        for row in rows
    )
