"""Read and change sessions: find one by its token, derive its stage and its public state."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, cast

from sqlalchemy import Connection, Table, bindparam, select, update
from sqlalchemy.dialects import postgresql, sqlite

from physion.experiment.protocol.messages import ENDED, SessionState, Stage
from physion.experiment.protocol.refused import Refused
from physion.experiment.store.tables import SESSIONS, TOKENS
from physion.experiment.study.stimuli import PHASES
from physion.experiment.study.study import Study

ACTIVE_WITHIN = 15 * 60.0
"""A session counts as active for this many seconds after its last request."""
ENTERED_AGAIN = "entered_again"
"""Kind of the event stored when a session is entered again; its data are the device."""
STAGES: tuple[Stage, ...] = (
    "consent", "instructions", "familiarization", "ready", "test", "demographics", "feedback",
    "done", *ENDED,
)  # fmt: skip


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
    ready_at: float | None
    demographics_at: float | None
    finished_at: float | None
    withdrawn_at: float | None
    closed_at: float | None
    voided_at: float | None
    browser: str | None
    next_from: float | None
    fast_answers: int
    unfetched: int
    replayed: int
    implausible: str | None
    answered_familiarization: int
    answered_test: int
    loads: int
    loaded_at_phase: str | None
    loaded_at_trial: int | None


SESSION_COLUMNS = tuple(SESSIONS.c[field.name] for field in fields(Session))
_BY_TOKEN = (
    select(*SESSION_COLUMNS)
    .join(TOKENS, TOKENS.c.session == SESSIONS.c.session)
    .where(TOKENS.c.token_hash == bindparam("token_hash"))
)


class TrialCounts:
    """Number of trials in each phase of each scenario."""

    def __init__(self, study: Study) -> None:
        self._counts: dict[str, dict[str, int]] = {
            scenario: {phase: len(study.phase(scenario, phase)) for phase in PHASES}
            for scenario in study.scenarios
        }

    def of(self, scenario: str) -> Mapping[str, int]:
        """Return the numbers of trials by phase.

        Raises
        ------
        Refused
            The study no longer has the scenario, which can only happen to previews
            (`study_record.register`).
        """
        if scenario not in self._counts:
            raise Refused(
                "unknown_token",
                "The study no longer has this scenario; open your link again.",
            )
        return self._counts[scenario]

    def has(self, scenario: str) -> bool:
        """Return whether the study currently has this scenario."""
        return scenario in self._counts


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


def stage_of(session: Session, trials: Mapping[str, int]) -> Stage:
    """Return the current stage of a session: the first one that is not complete."""
    if session.withdrawn_at is not None:
        declined = session.consented_at is None and session.closed_at is None
        return "declined" if declined else "withdrawn"
    if session.finished_at is not None:
        return "done"
    if session.voided_at is not None:
        return "withdrawn"
    complete = (
        session.consented_at is not None,
        session.instructed_at is not None,
        session.answered_familiarization >= trials["familiarization"],
        session.ready_at is not None,
        session.answered_test >= trials["test"],
        session.demographics_at is not None,
    )
    return STAGES[complete.index(False)] if False in complete else "feedback"


def can_take_back(session: Session) -> bool:
    """Return whether a participant who declined or stopped may still take part.

    Only while nothing was answered, and the lab has not closed or voided the session.
    """
    unanswered = session.answered_familiarization == session.answered_test == 0
    ended_by_lab = session.closed_at is not None or session.voided_at is not None
    return session.withdrawn_at is not None and unanswered and not ended_by_lab


def answered(session: Session, phase: str) -> int:
    """Return the number of answered trials of a phase, which is the index of the next trial."""
    return session.answered_test if phase == "test" else session.answered_familiarization


def state_of(session: Session, trials: Mapping[str, int]) -> SessionState:
    """Return the state of a session as sent to the client."""
    stage = stage_of(session, trials)
    return SessionState(
        stage=stage,
        trial=answered(session, stage) if stage in PHASES else None,
        trials=cast(Any, dict(trials)),
        scenario=session.scenario,
        language=session.language,
        kind=cast(Any, session.kind),
        buttons=cast(Any, session.buttons),
        reference=session.reference,
    )


def change_session(connection: Connection, session: Session, **values: Any) -> None:
    """Write columns of a session to the database and to ``session``."""
    assert "kind" not in values, "the kind of a session never changes"
    statement = update(SESSIONS).where(SESSIONS.c.session == session.session).values(**values)
    connection.execute(statement)
    for name, value in values.items():
        if hasattr(session, name):
            setattr(session, name, value)


def mark_loaded(session: Session, trials: Mapping[str, int]) -> dict[str, Any]:
    """Return the columns that record a reload of the page at the next trial, if a trial is next.

    The page was loaded before for the consent, so a load at a trial is always a reload.
    """
    stage = stage_of(session, trials)
    if stage not in PHASES:
        return {}
    return {"loaded_at_phase": stage, "loaded_at_trial": answered(session, stage)}


def insert_or_skip(connection: Connection, table: Table) -> Any:
    """Return an INSERT that skips rows which violate a UNIQUE constraint; see ``rowcount``."""
    return _insert_or_skip(connection.dialect.name, table)


@cache
def _insert_or_skip(dialect: str, table: Table) -> Any:
    """Return the statement of `insert_or_skip`, cached by dialect and table."""
    insert = postgresql.insert if dialect == "postgresql" else sqlite.insert
    # Without the option the rowcount of an INSERT is unreliable.
    return insert(table).on_conflict_do_nothing().execution_options(preserve_rowcount=True)


def storable(text: str) -> str:
    """Return a text without NUL and unpaired surrogates, which PostgreSQL cannot store."""
    return text.replace("\0", "").encode("utf-8", "replace").decode("utf-8")


def storable_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Apply `storable` to the names and texts of a flat object."""
    return {
        storable(name): storable(value) if isinstance(value, str) else value
        for name, value in values.items()
    }
