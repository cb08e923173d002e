"""A session as it stands: read by its token, with its stage and the state that a client is told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from functools import cache
from typing import Any, cast

from sqlalchemy import Connection, Table, bindparam, select, update
from sqlalchemy.dialects import postgresql, sqlite

from physion.experiment.protocol.messages import Stage, State
from physion.experiment.protocol.refused import Refused
from physion.experiment.store.tables import SESSIONS, TOKENS
from physion.experiment.study.stimuli import PHASES
from physion.experiment.study.study import Study

ACTIVE_WITHIN = 15 * 60.0
"""Seconds since a session was last heard of within which it counts as going on."""
ENTERED_AGAIN = "entered_again"
"""The event of someone who goes on with a session; its data are the device."""
STAGES: tuple[Stage, ...] = (
    "consent", "instructions", "familiarization", "ready", "test", "demographics", "feedback",
    "done", "withdrawn",
)  # fmt: skip


@dataclass(slots=True)
class Session:
    """What decides how a session goes on: these columns of SESSIONS."""

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


class Trials:
    """How many trials each phase of each scenario has."""

    def __init__(self, study: Study) -> None:
        self._counts: dict[str, dict[str, int]] = {
            scenario: {phase: len(study.phase(scenario, phase)) for phase in PHASES}
            for scenario in study.scenarios
        }

    def of(self, scenario: str) -> Mapping[str, int]:
        """Counts by phase; `Refused` for a scenario that the study has no more.

        Only previews can be of one (`study_record.register`).
        """
        if scenario not in self._counts:
            raise Refused("unknown_token", "The study has this part no more; open your link again.")
        return self._counts[scenario]

    def has(self, scenario: str) -> bool:
        """Is this a scenario of the study as it is now?"""
        return scenario in self._counts


def served_session(study: Study, row: Sequence[Any]) -> Session:
    """A session from its `SESSION_COLUMNS`, in a language that the study has, as it is served now.

    The row keeps the language in which the session began.
    """
    session = Session(*row)
    if session.language not in study.languages:
        session.language = study.languages[0]
    return session


def read_session(connection: Connection, study: Study, token_hash: str) -> Session:
    """The session that a token opens; `Refused` where it opens none."""
    row = connection.execute(_BY_TOKEN, {"token_hash": token_hash}).first()
    if row is None:
        raise Refused("unknown_token", "This session is not known here; open your link again.")
    return served_session(study, row)


def stage_of(session: Session, trials: Mapping[str, int]) -> Stage:
    """The stage that a session is in: the first that is not over."""
    if session.withdrawn_at is not None:
        return "withdrawn"
    if session.finished_at is not None:
        return "done"
    over = (
        session.consented_at is not None,
        session.instructed_at is not None,
        session.answered_familiarization >= trials["familiarization"],
        session.ready_at is not None,
        session.answered_test >= trials["test"],
        session.demographics_at is not None,
    )
    return STAGES[over.index(False)] if False in over else "feedback"


def answered(session: Session, phase: str) -> int:
    """How many trials of a phase are answered; the number of the next one."""
    return session.answered_test if phase == "test" else session.answered_familiarization


def state_of(session: Session, trials: Mapping[str, int]) -> State:
    """What the client is told of a session."""
    stage = stage_of(session, trials)
    return State(
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
    """Write some columns of a session, and have them in ``session`` too."""
    assert "kind" not in values, "what a session is stays as it began"
    statement = update(SESSIONS).where(SESSIONS.c.session == session.session).values(**values)
    connection.execute(statement)
    for name, value in values.items():
        if hasattr(session, name):
            setattr(session, name, value)


def mark_loaded(session: Session, trials: Mapping[str, int]) -> dict[str, Any]:
    """The columns that say at which trial the page was loaded; none where no trial is next.

    A page must have been loaded before, for the consent: so this was again.
    """
    stage = stage_of(session, trials)
    if stage not in PHASES:
        return {}
    return {"loaded_at_phase": stage, "loaded_at_trial": answered(session, stage)}


def insert_new(connection: Connection, table: Table) -> Any:
    """An INSERT that leaves out what would break a UNIQUE constraint; ``rowcount`` tells."""
    return _insert_new(connection.dialect.name, table)


@cache
def _insert_new(dialect: str, table: Table) -> Any:
    insert = postgresql.insert if dialect == "postgresql" else sqlite.insert
    # Without the option an INSERT's count of rows is not to be relied on.
    return insert(table).on_conflict_do_nothing().execution_options(preserve_rowcount=True)


def plain(text: str) -> str:
    """A text without what PostgreSQL cannot store: NUL, and halves of characters."""
    return text.replace("\0", "").encode("utf-8", "replace").decode("utf-8")


def plain_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """The same for names and texts of a flat object."""
    return {
        plain(name): plain(value) if isinstance(value, str) else value
        for name, value in values.items()
    }
