"""Scenarios in tables of results: names of summary rows, order, and lists of stimuli in files."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from pathlib import Path

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.names import OFFICIAL_SCENARIOS, SCENARIOS, canonical_name, scenario_of

MEAN = "mean"
"""Name of the row that averages the scores of the scenarios with equal weights."""

POOLED = "pooled"
"""Name of the row over the stimuli of all scenarios, so that larger scenarios count more."""


def in_order(scenarios: Iterable[object]) -> list[str]:
    """Return the scenarios that occur: the eight in the order of the paper, then others by name."""
    present = {str(name) for name in scenarios}
    return [name for name in SCENARIOS if name in present] + sorted(present - set(SCENARIOS))


def scenario_name(name: str) -> str:
    """Return our name of a scenario from our spelling or the official one, in any case.

    Raises `UnknownNameError` with the closest names.
    """
    lower = name.strip().lower()
    if lower in SCENARIOS:
        return lower
    if lower not in OFFICIAL_SCENARIOS:
        raise UnknownNameError("scenario", name, {*SCENARIOS, *OFFICIAL_SCENARIOS})
    return OFFICIAL_SCENARIOS[lower]


def read_stimulus_list(path: Path) -> list[str]:
    """Read the canonical names from a text file with one stimulus a line."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BadInputError(f"{path} cannot be read as a list of stimuli: {error}") from error
    names = [canonical_name(line) for line in text.splitlines() if line.strip()]
    if not names:
        raise BadInputError(f"{path} names no stimulus; it should have one a line")
    return names


def check_excluded_names(exclude: Iterable[str], known: Collection[str]) -> None:
    """Raise `UnknownNameError` for the first excluded stimulus that no table contains.

    A misspelt name would exclude nothing. Official names of scenarios of which ``known``, the
    stimuli of all tables, holds no other stimulus are accepted: one list may serve many files.
    """
    names = {canonical_name(name) for name in known}
    scenarios = {scenario_of(name) for name in names} - {None}
    for name in map(canonical_name, exclude):
        elsewhere = scenario_of(name) is not None and scenario_of(name) not in scenarios
        if name not in names and not elsewhere:
            raise UnknownNameError("stimulus to exclude", name, names)
