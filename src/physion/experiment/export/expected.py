"""The test stimuli that a complete session has answered: of its scenario, or of its blocks."""

from __future__ import annotations

from collections.abc import Sequence

from sqlalchemy import Connection, select

from physion.core.names import canonical_name
from physion.experiment.export.session_rows import SessionTable
from physion.experiment.store.database import SESSIONS
from physion.experiment.study.orders import trial_order
from physion.experiment.study.stimuli import Stimulus
from physion.experiment.study.study import ALL_SCENARIOS, Study, under


def expected_stimuli(
    connection: Connection, study: Study, sessions: SessionTable
) -> list[tuple[str, ...]]:
    """Return the rows of ``expected.csv`` with their header: stimulus and scenario.

    If sessions have several scenarios, each has rows of its own, with the column ``session``.
    """
    if not study.blocks.all_scenarios:
        rows = [(s.stimulus, s.scenario) for s in study.stimuli if s.phase == "test"]
        return [("stimulus", "scenario"), *rows]
    seeds = _seeds(connection)
    found: list[tuple[str, ...]] = [("stimulus", "scenario", "session")]
    for session in sessions.table.column("session").to_pylist():
        seed, condition = seeds[session]
        order = trial_order(under(study, condition), ALL_SCENARIOS, seed)["test"]
        found += [(s.stimulus, s.scenario, session) for s in order if s.phase == "test"]
    return found


def expected_names(connection: Connection, study: Study) -> dict[str, frozenset[str]]:
    """Return the expected stimuli as the analysis takes them, by scenario or by session."""
    if not study.blocks.all_scenarios:
        return {name.lower(): _names(study.phase(name, "test")) for name in study.scenarios}
    return {
        session: _names(trial_order(under(study, condition), ALL_SCENARIOS, seed)["test"])
        for session, (seed, condition) in _seeds(connection).items()
    }


def _names(stimuli: Sequence[Stimulus]) -> frozenset[str]:
    """Return the names of test stimuli, without the attention checks among them."""
    return frozenset(canonical_name(s.stimulus) for s in stimuli if s.phase == "test")


def _seeds(connection: Connection) -> dict[str, tuple[int, str | None]]:
    """Return seed and condition of the sessions that have several scenarios."""
    columns = SESSIONS.c
    chosen = select(columns.session, columns.order_seed, columns.condition)
    rows = connection.execute(chosen.where(columns.scenario == ALL_SCENARIOS))
    return {session: (seed, condition) for session, seed, condition in rows}
