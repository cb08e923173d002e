"""Completeness of sessions: the stimuli that a session must have answered, and answers to others.

The study's list of test stimuli decides (`read_expected`). Without one, a session must have the
stimuli that at least half of the scenario's sessions answered, so that one answer to an unknown
stimulus does not make every other session incomplete.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from physion.analysis.people.participants import Responses, scenarios_in
from physion.analysis.tables.csv_table import read_table
from physion.analysis.tables.stimuli import in_order
from physion.core.errors import BadInputError
from physion.core.names import OFFICIAL_SCENARIOS, canonical_name

Expected = Mapping[str, frozenset[str]]
"""Canonical names of the test stimuli by session or, for all sessions of it, by scenario."""

EXPECTED_FILE = "expected.csv"
"""File with the study's list of stimuli, in the folder of the exported responses."""

NOT_EXPECTED = "stimulus is not on the study's list"


def read_expected(path: Path) -> dict[str, frozenset[str]]:
    """Read the stimuli that a session must have from a list of them (CSV or parquet).

    Columns: ``stimulus``, and ``session`` (if each has a list of its own) or ``scenario``, whose
    values are the keys of the result. Raises `BadInputError`.
    """
    table = read_table(path, ("stimulus",))
    if "session" not in table and "scenario" not in table:
        raise BadInputError(f"{path} must say whose stimuli these are: column session or scenario")
    names = table["stimulus"].astype(str).map(canonical_name)
    if "session" in table:
        whose = table["session"].astype(str)
    else:
        lower = table["scenario"].astype(str).str.strip().str.lower()
        whose = lower.replace(OFFICIAL_SCENARIOS)
    return {str(key): frozenset(group) for key, group in names.groupby(whose)}


def find_expected(responses: Sequence[Path]) -> Path | None:
    """Return the list `EXPECTED_FILE` next to the responses of an export, or None."""
    paths = [file.parent / EXPECTED_FILE for file in responses]
    return next((path for path in paths if path.is_file()), None)


def check_expected(responses: Responses, expected: Expected | None) -> None:
    """Raise `BadInputError` for a list that names none of these sessions and scenarios."""
    known = {*responses.sessions["session"], *_each(responses.sessions["scenario"])}
    if expected is not None and not known & set(expected):
        raise BadInputError(
            f"the list of expected stimuli names {next(iter(expected), 'nothing')!r}, which is "
            "neither a session nor a scenario of the responses"
        )


def stimuli_of_most(test: pd.DataFrame) -> dict[str, frozenset[str]]:
    """Return by scenario the stimuli that at least half of its sessions with answers answered.

    ``test``: rows of the test phase. A scenario whose sessions saw different stimuli has none.
    """
    sessions = test.groupby("scenario")["session"].nunique()
    answered = test.groupby(["scenario", "stimulus"])["session"].nunique().reset_index()
    of_most = answered[2 * answered["session"] >= answered["scenario"].map(sessions)]
    found = {str(name): frozenset(rows["stimulus"]) for name, rows in of_most.groupby("scenario")}
    return {str(name): found.get(str(name), frozenset()) for name in sessions.index}


def expected_by_session(
    responses: Responses, expected: Expected | None
) -> dict[str, frozenset[str]]:
    """Return the stimuli that each session must have answered.

    Those of the list of the session, else of its scenarios, else `stimuli_of_most`; none for a
    scenario without either.
    """
    given = dict(expected or {})
    of_scenario = {**stimuli_of_most(responses.test), **given}
    found = {}
    for session, scenarios in responses.sessions[["session", "scenario"]].to_numpy():
        parts = [of_scenario.get(name, frozenset()) for name in scenarios_in(scenarios)]
        found[str(session)] = given.get(session, frozenset().union(*parts))
    return found


def drop_unexpected(responses: Responses, expected: Expected | None) -> Responses:
    """Return the responses without test answers to stimuli that are not on the study's list.

    Sessions without a list keep all answers. Flag sessions first: rules about the sequence of
    answers need all of them.
    """
    if expected is None:
        return responses
    in_list = responses.trials["session"].isin(_listed(responses, expected))
    return responses.drop_rows(
        _not_expected(responses, expected) & in_list, "stimuli", NOT_EXPECTED
    )


def completeness_warnings(responses: Responses, expected: Expected | None) -> list[str]:
    """Return what users should know about completeness, at most one sentence a scenario.

    They are about answers to stimuli that are not expected, and about scenarios whose sessions
    cannot be judged because they saw different stimuli.
    """
    of_session = expected_by_session(responses, expected)
    listed = _listed(responses, expected or {})
    others = responses.trials[_not_expected(responses, expected)]
    found = []
    for scenario in in_order(responses.test["scenario"]):
        sessions = set(responses.test.loc[responses.test["scenario"] == scenario, "session"])
        rows = others[others["scenario"] == scenario]
        if not any(of_session[session] for session in sessions):
            found.append(
                f"{scenario}: no stimulus was answered by half of the {len(sessions)} sessions, so "
                "no session with answers counts as incomplete; give the study's list (--expected)"
            )
        elif len(rows):
            which, consequence = (
                ("are not on the study's list", "are left out")
                if sessions & listed
                else ("fewer than half of the sessions answered", "do not count for completeness")
            )
            found.append(
                f"{scenario}: answers to stimuli that {which} {consequence}: {len(rows)}, the "
                f"first to {rows['stimulus'].iloc[0]!r}"
            )
    return found


def _listed(responses: Responses, expected: Expected) -> set[str]:
    """Return the sessions for which the list names stimuli, by session or by scenario."""
    rows = responses.sessions
    of_scenario = [any(name in expected for name in scenarios_in(s)) for s in rows["scenario"]]
    given = rows["session"].isin(set(expected)) | np.array(of_scenario, dtype=bool)
    return set(rows.loc[given, "session"])


def _each(sets: pd.Series) -> set[str]:
    """Return each scenario of some `scenario_set`."""
    return {name for scenarios in sets.unique() for name in scenarios_in(scenarios)}


def _not_expected(responses: Responses, expected: Expected | None) -> pd.Series:
    """Return which rows of the trials are test answers to a stimulus that is not expected."""
    of_session = expected_by_session(responses, expected)
    trials = responses.trials
    pairs = zip(trials["session"], trials["stimulus"], strict=True)
    found = [stimulus not in of_session[session] for session, stimulus in pairs]
    return pd.Series(found, index=trials.index, dtype=bool) & (trials["phase"] == "test")
