"""What an export says of itself to people: its README, and columns that only it has."""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import fill
from typing import Any, Literal

from physion.analysis.people.response_schema import PHASES, Column
from physion.experiment.export.bids import TEXT_RULE
from physion.experiment.export.spreadsheet import RULE
from physion.experiment.study.stimuli import LOOKS
from physion.experiment.study.study import Study

STIMULI_COLUMNS: tuple[Column, ...] = (
    Column("stimulus", "text", "Name, as in the trials"),
    Column("scenario", "text", "Scenario, as in the trials"),
    Column("phase", "choice", "Where it is shown", choices=PHASES),
    Column("place", "integer", "Place in familiarization, from 0; no order in the test", low=0),
    Column("label", "flag", "Does the agent touch the patient?"),
    Column("frames", "integer", "Frames of the observed movie", low=1),
    Column("rate", "number", "Frames a second", unit="Hz", low=0),
    Column("width", "integer", "Width of the movie", unit="px", low=1),
    Column("height", "integer", "Height of the movie", unit="px", low=1),
    Column("look", "choice", "Colours of the stimulus", choices=LOOKS),
)

_TASK = """\
Participants saw the first part of a movie, after agent and patient had been marked in red and
yellow, and said whether the one would touch the other. One session is one participant in one
scenario: familiarization with feedback, then the test without."""

_PEOPLE = """\
`participant` is a keyed hash: the same for all sessions of a person in this study, and of no use
without the study's key. No recruiter's id is in here. Free text and rare combinations of age,
gender and education may still tell who somebody is: look through them before you share the data.
Sessions that `simulated` marks were made by a program."""

_FILES = """\
- `trials.csv`, `trials.parquet`: one row a session and trial.
- `sessions.csv`, `sessions.parquet`: one row a session.
- `events.csv`, `events.parquet`: what else happened in the browser.
- `trial_details.parquet`: moments of frames and cues within each trial.
- `stimuli.csv`: what was shown and how it ends. `expected.csv`: the test of each scenario.
- `data_dictionary.json`: every column of every table.
- `study.json`: what the study decided and said, in each state in which sessions ran.
- `psych-ds/`, `bids/`: trials and sessions in these two conventions, where asked for.
- `export.json`: counts, and what was left out.

The rows of `trials` are told apart by `session`, `phase` and `trial`. To compare them with models:

    physion compare PREDICTIONS --responses trials.csv --sessions sessions.csv \\
        --expected expected.csv

Sessions that were not finished are in the tables; the analysis flags them. Sessions of people who
withdrew or did not agree, and previews, are not."""

_PSYCH_DS = """\
A Psych-DS dataset (psych-ds.github.io). The rows of `..._description-trials_data.csv` are told
apart by `session`, `phase` and `trial`, those of `..._description-sessions_data.csv` by `session`,
those of `..._description-events_data.csv` by `session` and `number`."""

_BIDS = """\
A BIDS dataset of behaviour without recordings (bids.neuroimaging.io): one file a participant and
scenario. Practice trials come first, `trial_type` tells them from the test. Participants without
any answer have no file and are not listed."""


def readme(
    study: Study,
    place: Literal["export", "psych-ds", "bids"],
    facts: Mapping[str, Any] | None = None,
) -> str:
    """README.md of the export or of one of the two conventions' folders."""
    special = {"export": _FILES, "psych-ds": _PSYCH_DS, "bids": _BIDS}[place]
    rule = RULE if place != "bids" else f"{TEXT_RULE}. {RULE}"
    parts = [
        f"# {study.title}",
        f"Study {study.name}, version {study.version}. Contact: {study.contact}",
        _TASK,
        special,
        _PEOPLE,
        fill(rule, 100),
    ]
    if facts is not None:
        parts.append("## Counts\n\n" + "\n".join(count_lines(facts, "- ")))
    return "\n\n".join(parts) + "\n"


def count_lines(facts: Mapping[str, Any], bullet: str = "") -> list[str]:
    """Counts of a report, a line each."""
    lines = []
    for kind, states in facts["sessions"].items():
        total = sum(states.values())
        lines.append(f"{bullet}{kind}: {total} sessions, {states['finished']} finished")
    if not lines:
        lines.append(f"{bullet}no session")
    counts = ", ".join(f"{count} {name}" for name, count in facts["rows"].items())
    lines.append(f"{bullet}rows: {counts}")
    for entry in facts["left_out"]:
        whose = "" if entry["kind"] == "any" else f" ({entry['kind']})"
        what = entry["what"] + ("s" if entry["count"] != 1 else "")
        lines.append(f"{bullet}left out: {entry['count']} {what}{whose}: {entry['reason']}")
    if facts["data_until"]:
        lines.append(f"{bullet}data until {facts['data_until']}")
    return lines
