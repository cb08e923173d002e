"""Attributes of stimuli: how many elements, distractors and occluders they hold.

Three sources, each named in the column ``source``: the official names, which say what the
configuration was called; the official ``metadata.json`` files, which say what was generated; any
table with the columns, such as that of one's own stimuli. Where metadata are given they go before
names (`better_attributes`); names that are known to be wrong are corrected (`MISLABELLED`). What a
source does not say is NaN.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from physion.analysis.tables.csv_table import refuse_duplicates, require_columns
from physion.errors import BadInputError
from physion.stimulus_names import SCENARIOS, canonical_name, scenario_of

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
    """Attributes by what official names say, `MISLABELLED` ones corrected; columns `COLUMNS`, one
    row a stimulus.

    A name that does not mention scenery (``..._simple_box``) stands for a stimulus without it: 0.
    ``elements`` are NaN where the name gives none or, as in Link, a range of them. Raises
    `BadInputError` for a name of no official scenario.
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
    found = {name: _first(patterns, configuration) for name, patterns in _PATTERNS.items()}
    if scenario in _ALWAYS_ONE_EACH:
        found |= {"distractors": 1.0, "occluders": 1.0}
    for name in ("distractors", "occluders"):
        if np.isnan(found[name]):
            found[name] = 0.0
    if "midRM1" in configuration:
        found["elements"] -= 1
    if scenario in ("link", "contain"):
        found["elements"] = np.nan
    found |= MISLABELLED.get(configuration, {})
    room = "tdw" if "tdw" in configuration else "box"
    return {"stimulus": stimulus, "scenario": scenario, "configuration": configuration, **found,
            "room": room, "source": "name"}  # fmt: skip


def _first(patterns: tuple[re.Pattern[str], ...], text: str) -> float:
    for pattern in patterns:
        if match := pattern.search(text):
            return float(match[1])
    return float("nan")


def attributes_from_metadata(folder: Path) -> pd.DataFrame:
    """Attributes from all ``<scenario>/<configuration>/metadata.json`` under ``folder``.

    Links and blocks that the metadata do not count are NaN. Raises `BadInputError`.
    """
    rows = []
    for path in sorted(folder.glob("*/*/metadata.json")):
        try:
            trials = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise BadInputError(f"{path} is not JSON: {error}") from error
        if not isinstance(trials, list) or not all(isinstance(trial, dict) for trial in trials):
            raise BadInputError(f"{path} is not a list of trials")
        scenario = path.parents[1].name
        rows += [_from_metadata(trial, scenario, path) for trial in trials]
    if not rows:
        raise BadInputError(f"{folder} holds no <scenario>/<configuration>/metadata.json")
    table = pd.DataFrame(rows, columns=list(COLUMNS))
    refuse_duplicates(table["stimulus"], str(folder))
    return table


def _from_metadata(trial: dict[str, Any], scenario: str, path: Path) -> dict[str, Any]:
    name = trial.get("stimulus_name")
    if not isinstance(name, str):
        raise BadInputError(f"{path}: a trial has no stimulus_name")
    middle = _count(trial, "num_middle_objects")
    removed = str(trial.get("remove_middle")).lower() == "true"
    # The generator of Drop inherits a count of 0 that means nothing.
    counted = scenario in ("dominoes", "support")
    room = re.sub(r"^b?'?([a-z]*)'?$", r"\1", str(trial.get("room", "")))
    return {
        "stimulus": canonical_name(name),
        "scenario": scenario if scenario in SCENARIOS else scenario_of(canonical_name(name)),
        "configuration": path.parent.name,
        "elements": middle - removed if counted else np.nan,
        "distractors": _count(trial, "num_distractors"),
        "occluders": _count(trial, "num_occluders"),
        "room": room,
        "source": "metadata",
    }


def _count(trial: dict[str, Any], key: str) -> float:
    value = pd.to_numeric(str(trial.get(key)), errors="coerce")
    return float(value)


def attributes_from_table(table: pd.DataFrame, where: str = "table of attributes") -> pd.DataFrame:
    """Attributes from a table with ``stimulus``, ``scenario`` and any of `ATTRIBUTES`."""
    require_columns(table, ["stimulus", "scenario"], where)
    given = [name for name in ATTRIBUTES if name in table]
    if not given:
        raise BadInputError(f"{where} has none of the columns {', '.join(ATTRIBUTES)}")
    found = table[["stimulus", "scenario"]].assign(configuration="", room="", source="table")
    found["stimulus"] = found["stimulus"].map(canonical_name)
    for name in ("configuration", "room"):
        if name in table:
            found[name] = table[name]
    for name in ATTRIBUTES:
        numbers = pd.to_numeric(table[name], errors="coerce") if name in table else np.nan
        found[name] = numbers
    refuse_duplicates(found["stimulus"], where)
    return found[list(COLUMNS)].reset_index(drop=True)


def better_attributes(first: pd.DataFrame, second: pd.DataFrame) -> pd.DataFrame:
    """``first`` where it knows the stimulus, ``second`` for the others: metadata, then names."""
    missing = second[~second["stimulus"].isin(first["stimulus"])]
    return pd.concat([first, missing], ignore_index=True)
