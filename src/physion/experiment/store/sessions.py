"""Read and change sessions: find one by its token, derive its stage and its public state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal, cast

from sqlalchemy import Connection, Table, bindparam, select, update
from sqlalchemy.dialects.sqlite import insert

from physion.experiment.protocol import (
    ENDED,
    PAGES,
    STAGES,
    Course,
    Refused,
    SessionSettings,
    SessionState,
    Stage,
)
from physion.experiment.store.database import EVENTS, SESSIONS, TOKENS
from physion.experiment.study.orders import session_trials
from physion.experiment.study.stimuli import PHASES
from physion.experiment.study.study import Study, under

ACTIVE_WITHIN = 15 * 60.0
"""A session counts as active for this many seconds after its last request."""
ENTERED_AGAIN = "entered_again"
"""Kind of the event stored when a session is entered again; its data are the device."""


@dataclass(slots=True)
class Session:
    """The columns of SESSIONS that determine how a session continues."""

    session: str
    participant: str
    scenario: str
    kind: str
    order_seed: int
    buttons: str
    language: str
    reference: str
    started_at: float
    consented_at: float | None
    instructed_at: float | None
    comprehended_at: float | None
    comprehension_attempts: int
    practice_repeats: int
    attention_failed: int
    failed_checks: str | None
    ready_at: float | None
    demographics_at: float | None
    questions_at: float | None
    finished_at: float | None
    withdrawn_at: float | None
    closed_at: float | None
    screened_out_at: float | None
    voided_at: float | None
    browser: str | None
    next_from: float | None
    fast_answers: int
    unfetched: int
    replayed: int
    implausible: str | None
    answered_familiarization: int
    answered_test: int
    condition: str | None
    loads: int
    loaded_at_phase: str | None
    loaded_at_trial: int | None


SESSION_COLUMNS = tuple(SESSIONS.c[field.name] for field in fields(Session))
_BY_TOKEN = (
    select(*SESSION_COLUMNS)
    .join(TOKENS, TOKENS.c.session == SESSIONS.c.session)
    .where(TOKENS.c.token_hash == bindparam("token_hash"))
)


def stages_of(study: Study) -> tuple[Stage, ...]:
    """Return the stages of a study's sessions in order, ``done`` last."""
    absent = {
        "comprehension": not study.comprehension_questions,
        "demographics": not study.demographics,
        "questions": not study.questions,
    }
    return tuple(stage for stage in STAGES if stage not in ENDED and not absent.get(stage))


class Courses:
    """The `Course` of the sessions of a study."""

    def __init__(self, study: Study) -> None:
        self._study, self._stages = study, stages_of(study)

    def of(self, session: Session) -> Course:
        """Return the course of a session.

        Raises
        ------
        Refused
            The study no longer has the scenario, which can only happen to previews
            (`store.register`).
        """
        if not self.has(session):
            raise Refused(
                "unknown_token",
                "The study no longer has this scenario; open your link again.",
            )
        study = under(self._study, session.condition)
        trials = session_trials(study, session.scenario)
        settings = {
            "cue_ms": study.timing.cue_ms,
            "flash_hz": study.timing.flash_hz,
            "break_every": study.timing.break_every,
            "familiarization_feedback": study.familiarization_feedback,
        }
        return Course(self._stages, trials, settings)

    def has(self, session: Session) -> bool:
        """Return whether the study currently has the scenario of a session."""
        return session.scenario in under(self._study, session.condition).scenarios


def new_session_of(values: Mapping[str, Any]) -> Session:
    """Return the session of a row that is inserted with these columns and defaults elsewhere."""
    defaults = {column.name: 0 if column.default else None for column in SESSION_COLUMNS}
    return Session(**{name: values.get(name, default) for name, default in defaults.items()})


def session_from_row(study: Study, row: Sequence[Any]) -> Session:
    """Return the session of a row of `SESSION_COLUMNS`, in a language that the study has now.

    The database keeps the language in which the session began.
    """
    session = Session(*row)
    if session.language not in study.languages:
        session.language = study.languages[0]
    return session


def read_session(connection: Connection, study: Study, token_hash: str) -> Session:
    """Return the session of a token; raise `Refused` if there is none."""
    row = connection.execute(_BY_TOKEN, {"token_hash": token_hash}).first()
    if row is None:
        raise Refused("unknown_token", "This session is unknown; open your link again.")
    return session_from_row(study, row)


def end_of(session: Any) -> Literal["void", "finished", "withdrawn", "screened_out"] | None:
    """Return how a session, or its row, ended; None while it can continue.

    The lab can void a session that has ended, too.
    """
    if session.voided_at is not None:
        return "void"
    if session.finished_at is not None:
        return "finished"
    if session.withdrawn_at is not None:
        return "withdrawn"
    return "screened_out" if session.screened_out_at is not None else None


def stage_of(session: Session, course: Course) -> Stage:
    """Return the current stage of a session: the first one that is not complete."""
    end = end_of(session)
    if session.finished_at is not None:  # also of a void session
        return "done"
    if end == "screened_out":
        return end
    if end is not None:
        return "declined" if session.consented_at is None else "withdrawn"
    for stage in course.stages:
        if stage in PHASES:
            complete = answered(session, stage) >= course.trials[stage]
        else:
            complete = stage in PAGES and getattr(session, PAGES[stage].column) is not None
        if not complete:
            return stage
    raise AssertionError("a session whose last page was sent is finished")


def answered(session: Session, phase: str) -> int:
    """Return the number of answered trials of a phase, which is the index of the next trial."""
    return session.answered_test if phase == "test" else session.answered_familiarization


def state_of(session: Session, course: Course) -> SessionState:
    """Return the state of a session as sent to the client."""
    stage = stage_of(session, course)
    return SessionState(
        stage=stage,
        ended=stage in ENDED,
        trial=answered(session, stage) if stage in PHASES else None,
        trials=cast("Any", dict(course.trials)),
        comprehension_attempts=session.comprehension_attempts,
        practice_repeats=session.practice_repeats,
        answered=any(answered(session, phase) for phase in PHASES),
        condition=session.condition or "",
        settings=SessionSettings.model_validate(course.settings),
        scenario=session.scenario,
        language=session.language,
        kind=cast("Any", session.kind),
        buttons=cast("Any", session.buttons),
        reference=session.reference,
    )


@dataclass
class Step:
    """What one request of a participant works on.

    Attributes
    ----------
    connection
        Connection to the database; the writer's connection, in a transaction, if anything changes.
    study
        The study under the condition of the session.
    course
        What the session consists of.
    session
        The session; changes are made here too.
    now
        Time of the server in seconds since 1970.
    """

    connection: Connection
    study: Study
    course: Course
    session: Session
    now: float

    @property
    def stage(self) -> Stage:
        """The current stage."""
        return stage_of(self.session, self.course)

    @property
    def state(self) -> SessionState:
        """The state as sent to the client."""
        return state_of(self.session, self.course)

    def refused(self, code: str, message: str) -> Refused:
        """Return a refusal with the state from which the client can continue."""
        return Refused(code, message, self.state)

    def change(self, **values: Any) -> None:
        """Write columns of the session to the database and to ``session``."""
        assert "kind" not in values, "the kind of a session never changes"
        own = SESSIONS.c.session == self.session.session
        self.connection.execute(update(SESSIONS).where(own).values(**values))
        for name, value in values.items():
            if hasattr(self.session, name):
                setattr(self.session, name, value)

    def add_event(self, kind: str, data: Mapping[str, Any]) -> None:
        """Store an event of the session itself."""
        values = {"session": self.session.session, "kind": kind, "at_ms": 0.0}
        self.connection.execute(insert(EVENTS), values | {"stored_at": self.now, "data": data})

    def loaded(self) -> dict[str, Any]:
        """Return the columns that record a reload of the page at the next trial, if one is next.

        The page was loaded before for the consent, so a load at a trial is always a reload.
        """
        if self.stage not in PHASES:
            return {}
        trial = answered(self.session, self.stage)
        return {"loaded_at_phase": self.stage, "loaded_at_trial": trial}


def with_check(session: Session, check: str) -> dict[str, str]:
    """Return the column of the failed checks of a session, with one more."""
    known = session.failed_checks.split(", ") if session.failed_checks else []
    return {"failed_checks": ", ".join(known if check in known else [*known, check])}


def insert_or_skip(table: Table) -> Any:
    """Return an INSERT that skips rows which violate a UNIQUE constraint; see ``rowcount``."""
    # Without the option the rowcount of an INSERT is unreliable.
    return insert(table).on_conflict_do_nothing().execution_options(preserve_rowcount=True)
