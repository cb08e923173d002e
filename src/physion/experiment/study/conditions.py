"""Between-subject conditions: settings and texts that differ between groups of sessions.

``study.toml`` has one table ``[[conditions]]`` for each. Texts of a condition stand in the file of
each language, in ``[condition.NAME.TABLE]``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from physion.core.errors import BadInputError
from physion.experiment.study.stimuli import NAME
from physion.experiment.study.study_checks import Key, flag, listed, number, pattern, whole

WITHOUT_FEEDBACK = ("instructions.answer", "ready.text")
"""Texts that speak of feedback, which a condition without it must replace."""


@dataclass(frozen=True)
class Condition:
    """A between-subject condition; None: as in the rest of ``study.toml``.

    Attributes
    ----------
    name
        Name in the data, in links and in the keys of its texts.
    cue_ms, flash_hz, break_every
        In place of these keys of ``[timing]``.
    familiarization_feedback
        In place of this key: whether familiarization answers get feedback.
    scenarios
        The scenarios of its sessions, some of those of the study; thus also its own movies.
    """

    name: str
    cue_ms: int | None = None
    flash_hz: float | None = None
    break_every: int | None = None
    familiarization_feedback: bool | None = None
    scenarios: tuple[str, ...] | None = None


_name = pattern(
    r"[A-Za-z][A-Za-z0-9_-]{0,39}", "a word of letters, digits, _ and -, at most 40 characters"
)
_scenario = pattern(NAME, "the name of a scenario")
KEYS = (
    Key("conditions", "name", _name, "A word of letters, digits, _ and -.", required=True),
    Key("conditions", "cue_ms", whole(0, 60_000), "In place of the key of [timing]."),
    Key("conditions", "flash_hz", number(0, 3), "In place of the key of [timing]."),
    Key("conditions", "break_every", whole(0, 100_000), "In place of the key of [timing]."),
    Key("conditions", "familiarization_feedback", flag,
        "In place of the key above: whether familiarization answers get feedback."),
    Key("conditions", "scenarios", listed(_scenario, 1),
        "The scenarios of its sessions, such as [\"collide_slow\"] for movies of its own."),
)  # fmt: skip
ABOUT = """\
Between-subject conditions: one table [[conditions]] for each, with a name and those keys below that
differ from the study. A new session gets the condition with the fewest sessions. Texts of a
condition are in texts/: [condition.NAME.trial] with prompt = "..." is its question."""


def parse_conditions(
    entries: Sequence[Mapping[str, Any]], scenarios: Sequence[str], path: Path
) -> tuple[Condition, ...]:
    """Return the conditions of ``study.toml`` from the checked values of their tables.

    Raises `BadInputError` for one condition alone, a name that occurs twice, or a scenario that is
    not in ``scenarios``, those of the study.
    """
    found = tuple(Condition(**entry) for entry in entries)
    names = [condition.name for condition in found]
    if len(found) == 1:
        raise BadInputError(f"{path}: [[conditions]] needs at least two conditions")
    for condition in found:
        if names.count(condition.name) > 1:
            raise BadInputError(f"{path}: two conditions are called {condition.name}")
        for scenario in condition.scenarios or ():
            if scenario not in scenarios:
                raise BadInputError(
                    f"{path}: the condition {condition.name} has the scenario {scenario}, which is "
                    "not in scenarios"
                )
    return found


def own_text_keys(conditions: Sequence[Condition], *, blocks: bool) -> tuple[str, ...]:
    """Return the keys of texts that conditions need: of those without feedback, about practice."""
    wanted = (*WITHOUT_FEEDBACK, *(("block.practice",) if blocks else ()))
    return tuple(
        f"condition.{condition.name}.{key}"
        for condition in conditions
        if condition.familiarization_feedback is False
        for key in wanted
    )
