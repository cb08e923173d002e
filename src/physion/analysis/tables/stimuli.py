"""Names of stimuli and scenarios: the official spellings beside ours."""

from __future__ import annotations

import re
from pathlib import Path

from physion.errors import BadInputError, UnknownNameError

SCENARIOS = ("dominoes", "support", "collide", "contain", "drop", "link", "roll", "drape")
"""The eight scenarios in the order of the paper."""

OFFICIAL_SCENARIOS = {
    "dominoes": "dominoes",
    "towers": "support",
    "collision": "collide",
    "containment": "contain",
    "drop": "drop",
    "linking": "link",
    "rollingsliding": "roll",
    "clothiness": "drape",
}
"""What the official files call a scenario, and what we call it."""

_REDYELLOW = "-redyellow"

_PREFIXES = (
    ("pilot_dominoes_", "dominoes"),
    ("pilot_towers_", "support"),
    ("pilot_it2_collision_", "collide"),
    ("pilot-containment-", "contain"),
    ("pilot_it2_drop_", "drop"),
    ("pilot_linking_", "link"),
    ("pilot_it2_rollingSliding_", "roll"),
)
_DRAPE = re.compile(r"test\d+_\d+$")


def canonical_name(stimulus: str) -> str:
    """A stimulus without what only says how it looks or in which file it lies.

    ``-redyellow`` (the same trial with a red agent and a yellow patient) and the endings ``_img``,
    ``_img.mp4``, ``.mp4`` and ``.hdf5`` are taken off, so that tables of either look can be joined.
    """
    name = stimulus.strip()
    for ending in (".mp4", ".hdf5", "_img"):
        name = name.removesuffix(ending)
    return name.replace(_REDYELLOW, "")


def scenario_name(name: str) -> str:
    """Our name of a scenario that is spelt in our way or in the official one.

    Raises `UnknownNameError` with the closest names.
    """
    lower = name.strip().lower()
    if lower in SCENARIOS:
        return lower
    if lower not in OFFICIAL_SCENARIOS:
        raise UnknownNameError("scenario", name, {*SCENARIOS, *OFFICIAL_SCENARIOS})
    return OFFICIAL_SCENARIOS[lower]


def scenario_of(stimulus: str) -> str | None:
    """The scenario that an official stimulus name betrays; None for any other name."""
    for prefix, scenario in _PREFIXES:
        if stimulus.startswith(prefix):
            return scenario
    return "drape" if _DRAPE.match(stimulus) else None


def is_ledge(stimulus: str) -> bool:
    """Is it one of the Roll stimuli with a ledge, which the study leaves out of all analyses?"""
    return stimulus.startswith("pilot_it2_rollingSliding_simple_ledge_")


def read_stimulus_list(path: Path) -> list[str]:
    """Canonical names in a text file of one stimulus a line, such as the list of glitchy trials."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise BadInputError(f"{path} cannot be read as a list of stimuli: {error}") from error
    names = [canonical_name(line) for line in text.splitlines() if line.strip()]
    if not names:
        raise BadInputError(f"{path} names no stimulus; it should have one a line")
    return names
