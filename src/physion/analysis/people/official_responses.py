"""Reader of participant-level answers in the raw columns of the original study.

The study's exports are ``human_responses-<study>-<iteration>.csv`` (150 test trials a session) and
``familiarization_human_responses-...`` (10 trials). Their ``rt`` starts before the cue.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from physion.analysis.people.participants import Refuse, Responses, clean
from physion.analysis.people.response_schema import TRIAL_COLUMNS, check_table
from physion.analysis.tables.csv_table import read_csv
from physion.core.errors import BadInputError
from physion.core.names import OFFICIAL_SCENARIOS, canonical_name, scenario_of

RT_OFFSET_MS = 2500.0
"""What the study takes off ``rt``. The cue of 2000 ms and 1500 ms of movie come before the buttons,
so that about 1000 ms of waiting remain in its response times: they compare with each other, not
with response times of our experiment (`BUTTONS_OFFSET_MS` would)."""

BUTTONS_OFFSET_MS = 3500.0
"""Cue and movie by the study's plan: the response time from about the moment of the buttons on."""

COLUMNS = ("gameID", "trialNum", "stim_ID", "response", "target_hit_zone_label", "rt")
"""Columns that must be there; ``prolificIDAnon`` (or ``prolificID``), ``correct``, ``choices``,
``condition`` are read where they are."""

_STUDY = re.compile(r"human_responses-(?P<study>[a-zA-Z]+)")
_PEOPLE = ("prolificIDAnon", "prolificID")


def read_official_responses(
    files: Sequence[Path],
    *,
    scenario: str | None = None,
    rt_offset_ms: float = RT_OFFSET_MS,
    known: Collection[str] | None = None,
    unknown: Refuse = "refuse",
    conflicts: Refuse = "refuse",
) -> Responses:
    """Read responses from the raw files of the study, test and familiarization together.

    The scenario of a file is ``scenario``, else that in its name, else that of its stimuli. A
    session is a ``gameID``; its participant is the Prolific id if there is one. ``rt_offset_ms`` is
    subtracted from ``rt``. The other parameters are those of `participants.read_responses`.
    """
    if not files:
        raise BadInputError("no file of responses was given")
    raw = pd.concat([_file(path, scenario, rt_offset_ms) for path in files], ignore_index=True)
    where = f"{files[0]}" if len(files) == 1 else f"{files[0]} and {len(files) - 1} more"
    table = check_table(raw, TRIAL_COLUMNS, where)
    return clean(table, where=where, known=known, unknown=unknown, conflicts=conflicts)


def _file(path: Path, scenario: str | None, offset: float) -> pd.DataFrame:
    """Read one file into our columns; text stays text."""
    raw = read_csv(path, COLUMNS)
    condition = raw["condition"] if "condition" in raw else pd.Series("prediction", index=raw.index)
    is_practice = condition.str.contains("familiarization")
    if "condition" not in raw and path.name.startswith("familiarization"):
        is_practice |= True
    # Where the number is missing, the order of the rows is the order of the answers.
    order = raw.groupby(["gameID", is_practice], sort=False).cumcount().astype(str)
    position = raw["trialNum"].where(~raw["trialNum"].str.lower().isin(("", "nan")), order)
    table = pd.DataFrame(
        {
            "participant": _participant(raw),
            "session": raw["gameID"],
            "scenario": scenario or _scenario(path, raw["stim_ID"]),
            "stimulus": raw["stim_ID"].map(canonical_name),
            "phase": np.where(is_practice, "familiarization", "test"),
            "trial": position,
            "response": raw["response"].str.lower().where(raw["response"].str.lower() != "nan", ""),
            "label": raw["target_hit_zone_label"],
            "simulated": False,
            "rt_ms": _response_time(raw["rt"], offset, path),
        }
    )
    if "correct" in raw:
        table["correct"] = raw["correct"]
    if "choices" in raw:
        table["buttons"] = raw["choices"].map(_buttons)
    return table


def _participant(raw: pd.DataFrame) -> pd.Series:
    for column in _PEOPLE:
        if column in raw:
            return raw[column].where(raw[column] != "", raw["gameID"])
    return raw["gameID"]


def _scenario(path: Path, stimuli: pd.Series) -> str:
    match = _STUDY.search(path.name)
    if match and match["study"].lower() in OFFICIAL_SCENARIOS:
        return OFFICIAL_SCENARIOS[match["study"].lower()]
    scenarios = {scenario_of(canonical_name(name)) for name in stimuli.unique()} - {None}
    if len(scenarios) != 1:
        raise BadInputError(
            f"{path}: neither its name nor its stimuli say which scenario it is; name the scenario"
        )
    return str(scenarios.pop())


def _response_time(rt: pd.Series, offset: float, path: Path) -> pd.Series:
    known = ~rt.str.lower().isin(("", "nan"))
    numbers = pd.to_numeric(rt.where(known), errors="coerce")
    broken = known & ~np.isfinite(numbers)
    if broken.any():
        row = int(np.flatnonzero(broken)[0])
        raise BadInputError(f"{path}: row {row + 1} of column 'rt' holds {rt.iloc[row]!r}")
    return numbers - offset


def _buttons(choices: str) -> str:
    """Return the order of the buttons from ``["YES", "NO"]``, ``['NO' 'YES']`` or ``YES,NO``."""
    words = re.findall(r"yes|no", choices.lower())
    return "-".join(words) if sorted(words) == ["no", "yes"] else ""
