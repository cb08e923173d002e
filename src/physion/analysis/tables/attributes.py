"""Attributes of stimuli: how many elements, distractors and occluders a scene contains.

Two sources, each named in the column ``source``: the official names of stimuli, which contain the
counts, and any table with the columns, such as that of one's own stimuli. A table has precedence
over names (`better_attributes`); names that are known to be wrong are corrected (`MISLABELLED`).
What a source does not contain is NaN.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd

from physion.analysis.tables.csv_table import refuse_duplicates, require_columns
from physion.core.errors import BadInputError
from physion.core.names import canonical_name, scenario_of

ATTRIBUTES = ("elements", "distractors", "occluders")
"""``elements``: objects that the physics is about beside probe, agent and zone: dominoes between
the first and the last, blocks of the tower, links. ``distractors``, ``occluders``: objects that
take no part, behind the scene and in front of it."""

COLUMNS = ("stimulus", "scenario", "configuration", *ATTRIBUTES, "room", "source")

MISLABELLED = {"pilot_dominoes_4mid_tdwroom": {"elements": 8.0}}
"""Configurations whose name belies what was generated, and what their metadata say: this one's
``num_middle_objects`` is 8 (docs/official-system.md, section 3.9). ``source`` stays *name*."""

_NUMBERED = re.compile(r"_?\d{4}$")
_PATTERNS: dict[str, tuple[re.Pattern[str], ...]] = {
    "elements": (re.compile(r"_(\d+)mid"), re.compile(r"_nb(\d+)_")),
    "distractors": (re.compile(r"_(\d+)_dis(?:_|$)"), re.compile(r"_dis(\d+)"),
                    re.compile(r"_d(\d+)chairs")),
    "occluders": (re.compile(r"_(\d+)_occ(?:_|$)"), re.compile(r"_occ(\d+)"),
                  re.compile(r"_o(\d+)(?:plants|full)")),
}  # fmt: skip
_ALWAYS_ONE_EACH = ("contain",)
"""Whose configurations all have one distractor and one occluder (but not in their names)."""


def attributes_from_names(stimuli: Iterable[str]) -> pd.DataFrame:
    """Return the attributes that official names contain, with `MISLABELLED` ones corrected.

    One row a stimulus with `COLUMNS`. A name without scenery (``..._simple_box``) means none: 0.
    ``elements`` are NaN if the name contains none or, as in Link, a range. Raises `BadInputError`
    for a name of no official scenario.
    """
    rows = [_from_name(canonical_name(name)) for name in stimuli]
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    refuse_duplicates(table["stimulus"], "the stimuli")
    return table


def _from_name(stimulus: str) -> dict[str, Any]:
    scenario = scenario_of(stimulus)
    if scenario is None:
        raise BadInputError(f"{stimulus!r} is no official name; give a table of attributes instead")
    configuration = _NUMBERED.sub("", stimulus)
    result = {name: _first(patterns, configuration) for name, patterns in _PATTERNS.items()}
    if scenario in _ALWAYS_ONE_EACH:
        result |= {"distractors": 1.0, "occluders": 1.0}
    for name in ("distractors", "occluders"):
        if np.isnan(result[name]):
            result[name] = 0.0
    if "midRM1" in configuration:
        result["elements"] -= 1
    if scenario in ("link", "contain"):
        result["elements"] = np.nan
    result |= MISLABELLED.get(configuration, {})
    room = "tdw" if "tdw" in configuration else "box"
    return {"stimulus": stimulus, "scenario": scenario, "configuration": configuration, **result,
            "room": room, "source": "name"}  # fmt: skip


def _first(patterns: tuple[re.Pattern[str], ...], text: str) -> float:
    for pattern in patterns:
        if match := pattern.search(text):
            return float(match[1])
    return float("nan")


def attributes_from_table(table: pd.DataFrame, where: str = "table of attributes") -> pd.DataFrame:
    """Return the attributes of a table with ``stimulus``, ``scenario`` and any of `ATTRIBUTES`."""
    require_columns(table, ["stimulus", "scenario"], where)
    given = [name for name in ATTRIBUTES if name in table]
    if not given:
        raise BadInputError(f"{where} has none of the columns {', '.join(ATTRIBUTES)}")
    result = table[["stimulus", "scenario"]].assign(configuration="", room="", source="table")
    result["stimulus"] = result["stimulus"].map(canonical_name)
    for name in ("configuration", "room"):
        if name in table:
            result[name] = table[name]
    for name in ATTRIBUTES:
        numbers = pd.to_numeric(table[name], errors="coerce") if name in table else np.nan
        result[name] = numbers
    refuse_duplicates(result["stimulus"], where)
    return result[list(COLUMNS)].reset_index(drop=True)


def better_attributes(first: pd.DataFrame, second: pd.DataFrame) -> pd.DataFrame:
    """Return ``first`` with the stimuli added that only ``second`` contains."""
    missing = second[~second["stimulus"].isin(first["stimulus"])]
    return pd.concat([first, missing], ignore_index=True)
