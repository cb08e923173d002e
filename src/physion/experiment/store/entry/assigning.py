"""Assign condition, scenario and order of trials to a new session: those that the fewest have."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import NamedTuple

from sqlalchemy import ColumnElement, Connection, and_, case, func, or_, select

from physion.core.seeds import stable_hash
from physion.experiment.protocol.refused import Refused
from physion.experiment.store.entry.visitor import Visitor
from physion.experiment.store.lab.managing import is_paused
from physion.experiment.store.sessions import ACTIVE_WITHIN
from physion.experiment.store.tables import SESSIONS
from physion.experiment.study.courses.blocks import block_orders
from physion.experiment.study.courses.variants import under, variants
from physion.experiment.study.identity import Secrets
from physion.experiment.study.orders import individual_order_seed, prepared_order_seed
from physion.experiment.study.recruitment import ending_completion
from physion.experiment.study.study import ALL_SCENARIOS, Study


def choose_course(
    connection: Connection, study: Study, visitor: Visitor, done: set[str], own: str | None
) -> tuple[Study, str]:
    """Return the study under the condition of a new session, and its scenario.

    The condition is that of the person's earlier sessions, else the one that the link fixes, else
    the one with the fewest sessions among those that have a place left in a wanted scenario.

    Parameters
    ----------
    connection
        Connection of the writer.
    study, visitor
        The study, and who enters.
    done
        Scenarios in which the visitor has a session already.
    own
        Condition of these sessions, if there are any.

    Raises
    ------
    Refused
        As `choose_scenario` does, for all conditions.
    """
    fixed = own or visitor.enter.condition
    ranked = variants(study) if fixed is None else (under(study, fixed),)
    if len(ranked) > 1:
        ranked = _fewest_first(connection, study, visitor)
    refused: Refused | None = None
    for variant in ranked:
        if visitor.enter.scenario not in (None, *variant.offered):
            continue
        try:
            return variant, choose_scenario(connection, variant, visitor, done)
        except Refused as error:
            refused = refused or error
    raise refused or Refused("bad_link", "This link names a scenario that its condition lacks.")


def _fewest_first(connection: Connection, study: Study, visitor: Visitor) -> tuple[Study, ...]:
    """Return the study under each condition, fewest sessions first; equal ones by seed.

    Sessions that ended early, are void or implausible, or that nobody goes on with, do not count.
    If the link names a scenario, sessions of this scenario alone do.
    """
    columns = SESSIONS.c
    wanted = visitor.enter.scenario
    statement = (
        select(columns.condition, func.count())
        .where(
            *_counted(study, visitor),
            *([] if wanted is None else [columns.scenario == wanted]),
        )
        .group_by(columns.condition)
    )
    used: dict[str | None, int] = dict(connection.execute(statement).all())

    def rank(variant: Study) -> tuple[int, int]:
        tie = stable_hash("condition", study.seed, visitor.participant, variant.condition)
        return used.get(variant.condition, 0), tie

    return tuple(sorted(variants(study), key=rank))


def _counted(study: Study, visitor: Visitor) -> tuple[ColumnElement[bool], ...]:
    """Return the conditions for plausible sessions of the visitor's kind that did not end early."""
    columns = SESSIONS.c
    return (
        columns.kind == visitor.kind,
        columns.withdrawn_at.is_(None),
        columns.voided_at.is_(None),
        columns.screened_out_at.is_(None),
        columns.implausible.is_(None),
        or_(*_in_use(study, visitor.now)),
    )


def choose_scenario(connection: Connection, study: Study, visitor: Visitor, done: set[str]) -> str:
    """Return the scenario of a new session: the requested one, else the one with fewest sessions.

    Scenarios in ``done`` are excluded, and for people also those that have enough participants.
    """
    requested = visitor.enter.scenario
    available = [
        scenario
        for scenario in study.offered
        if scenario not in done and requested in (None, scenario)
    ]
    if not available:
        raise Refused("already_took_part", "You have taken part already. Thank you!")
    if visitor.kind == "person" and is_paused(connection):
        raise Refused("paused", "The study takes in nobody at the moment; try again later.")
    counts = _count_sessions(connection, study, visitor)
    if visitor.kind == "person":
        available = [each for each in available if counts[each].taken < study.participants]
    if not available:
        raise Refused(
            "study_full",
            "The study has all the participants that it needs. Thank you!",
            completion=ending_completion(study.full, visitor.enter.source),
        )
    return min(available, key=lambda scenario: counts[scenario].begun)


class _SessionCounts(NamedTuple):
    """Numbers of sessions of a scenario.

    ``taken``: places of plausible sessions, finished or held for people who go on.
    ``begun``: finished and active sessions.
    """

    taken: int = 0
    begun: int = 0


def _count_sessions(
    connection: Connection, study: Study, visitor: Visitor
) -> Mapping[str, _SessionCounts]:
    """Count the sessions of the visitor's kind in each scenario."""
    counts_by_scenario: dict[str, _SessionCounts] = defaultdict(_SessionCounts)
    if visitor.kind != "person" and visitor.enter.scenario is not None:
        return counts_by_scenario  # the counts would not be used
    columns = SESSIONS.c
    finished, active, held = _in_use(study, visitor.now)
    taken = case((and_(columns.implausible.is_(None), or_(finished, held)), 1), else_=0)
    begun = case((or_(finished, active), 1), else_=0)
    statement = (
        select(columns.scenario, func.sum(taken), func.sum(begun))
        .where(
            columns.kind == visitor.kind,
            columns.withdrawn_at.is_(None),
            columns.voided_at.is_(None),
            columns.screened_out_at.is_(None),
            or_(finished, active, held),
        )
        .group_by(columns.scenario)
    )
    for scenario, *counts in connection.execute(statement):
        counts_by_scenario[scenario] = _SessionCounts(*counts)
    return counts_by_scenario


def _in_use(study: Study, now: float) -> tuple[ColumnElement[bool], ...]:
    """Return the conditions for sessions that are finished, active, or hold a place.

    A place is held from the consent on, until no page or answer has come for ``hold_minutes``.
    """
    columns = SESSIONS.c
    progressed_at = func.coalesce(columns.progressed_at, columns.last_seen)
    held_since = now - 60 * study.recruitment.hold_minutes
    return (
        columns.finished_at.is_not(None),
        columns.last_seen >= now - ACTIVE_WITHIN,
        # Somebody who only opened the page may never consent, and must not take a place.
        and_(columns.consented_at.is_not(None), progressed_at >= held_since),
    )


def assign_order(
    connection: Connection, study: Study, secrets: Secrets, scenario: str, visitor: Visitor
) -> tuple[int, int]:
    """Return the number of the prepared order of a new session, 0 if there is none, and its seed.

    The seed also determines the order of the blocks; the least used order is taken.
    """
    if study.orders:
        number = _least_used_order(connection, study, scenario, visitor.kind)
        return number, prepared_order_seed(study, secrets, scenario, number)
    blocks = 0
    if scenario == ALL_SCENARIOS:
        blocks = _least_used_blocks(connection, study, visitor)
    return 0, individual_order_seed(study, scenario, visitor.participant, blocks)


def _least_used_blocks(connection: Connection, study: Study, visitor: Visitor) -> int:
    """Return the index of the order of blocks with the fewest sessions; equal ones by seed.

    Sessions that ended early, or that nobody goes on with, give their place back.
    """
    count = len(block_orders(len(study.scenarios)))
    columns = SESSIONS.c
    index = columns.order_seed % count
    statement = (
        select(index, func.count())
        .where(
            columns.scenario == ALL_SCENARIOS,
            func.coalesce(columns.condition, "") == study.condition,
            *_counted(study, visitor),
        )
        .group_by(index)
    )
    used: dict[int, int] = dict(connection.execute(statement).all())

    def rank(number: int) -> tuple[int, int]:
        tie = stable_hash("order of blocks", study.seed, visitor.participant, number)
        return used.get(number, 0), tie

    return min(range(count), key=rank)


def _least_used_order(connection: Connection, study: Study, scenario: str, kind: str) -> int:
    """Return the number (from 1) of the prepared order with the fewest sessions so far."""
    columns = SESSIONS.c
    statement = (
        select(columns.order_number, func.count())
        .where(
            columns.scenario == scenario,
            func.coalesce(columns.condition, "") == study.condition,
            columns.kind == kind,
            columns.withdrawn_at.is_(None),
            columns.voided_at.is_(None),
            columns.screened_out_at.is_(None),
        )
        .group_by(columns.order_number)
    )
    used: dict[int, int] = dict(connection.execute(statement).all())
    return min(range(1, study.orders + 1), key=lambda number: (used.get(number, 0), number))
