"""The README files of an export, and the columns of its table of stimuli."""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import fill
from typing import Any, Literal

from physion.analysis.people.responses import Column
from physion.experiment.export.conventions.bids import TEXT_RULE
from physion.experiment.export.spreadsheet import RULE
from physion.experiment.study.stimuli import LOOKS, STIMULUS_PHASES
from physion.experiment.study.study import Study

STIMULI_COLUMNS: tuple[Column, ...] = (
    Column("stimulus", "text", "Name, as in the trials"),
    Column("scenario", "text", "Scenario, as in the trials"),
    Column(
        "phase",
        "choice",
        "Phase in which it is shown; attention: a check among the test trials",
        choices=STIMULUS_PHASES,
    ),
    Column("place", "integer", "Position in familiarization, from 0; no order in the test", low=0),
    Column("label", "flag", "Whether the agent touches the patient"),
    Column("frames", "integer", "Number of frames of the observed movie", low=1),
    Column("rate", "number", "Frames per second", unit="Hz", low=0),
    Column("width", "integer", "Width of the movie", unit="px", low=1),
    Column("height", "integer", "Height of the movie", unit="px", low=1),
    Column("look", "choice", "Colours of the stimulus", choices=LOOKS),
)

_TASK = """\
Participants saw the first part of a movie, in whose first frame the agent was marked in red and the
patient in yellow, and predicted whether the agent would touch the patient."""

_ONE_SCENARIO = """ A session is one
participant in one scenario: familiarization with feedback, then the test without feedback."""

_BLOCKS = """ A session has
all scenarios of the study, one block each, in an order of its own: the column `scenario` of the
sessions names them in this order, and the column `block` of the trials counts them from 0. Trials
are counted over the whole session. {practice}, with feedback; a test has no
feedback."""
_PRACTICE = {
    "each": "Each block begins with a familiarization",
    "first": "The first block begins with a familiarization",
}

_PEOPLE = """\
`participant` is a keyed hash: the same for all sessions of a person in this study, and of no use
without the study's key. Recruiters' ids are not exported. Free text, rare combinations of age,
gender and education, times of answers to the millisecond, and the descriptions of browser and
screen may still identify a person: check them before you share the data.
Sessions with `simulated` = true are of simulated participants."""

_FILES = """\
- `trials.csv`, `trials.parquet`: one row per trial.
- `sessions.csv`, `sessions.parquet`: one row per session.
- `questions.csv`, `questions.parquet`: one row per session that answered the questions of the lab,
  if it asks some.
- `practice_repeats.csv`, `practice_repeats.parquet`: answers to practice trials that were repeated
  afterwards, if there are some; `trials` has the last repeat.
- `attention_checks.csv`, `attention_checks.parquet`: answers to attention checks, if there are any.
- `events.csv`, `events.parquet`: other events in the browser.
- `trial_details.parquet`: times of frames and cues within each trial.
- `stimuli.csv`: the stimuli and their outcomes. `expected.csv`: the test stimuli by scenario.
- `data_dictionary.json`: description of every column of every table.
- `study.json`: settings and texts of each version of the study under which sessions ran.
- `psych-ds/`, `bids/`: trials and sessions in these two conventions, if requested.
- `export.json`: counts, and what was left out.

A row of `trials` is identified by `session`, `phase` and `trial`. To compare them with models:

    physion compare PREDICTIONS --responses trials.csv --sessions sessions.csv \\
        --expected expected.csv

Unfinished sessions are included; the analysis flags them. Previews and sessions of people who
withdrew or did not consent are not included."""

_PSYCH_DS = """\
A Psych-DS dataset (psych-ds.github.io). A row of `..._description-trials_data.csv` is identified by
`session`, `phase` and `trial`, a row of `..._description-sessions_data.csv` by `session`, a row of
`..._description-events_data.csv` by `session` and `number`. If the lab asks
questions of its own, a row of `..._description-questions_data.csv` is identified by `session`."""

_BIDS = """\
A BIDS dataset of behaviour without recordings (bids.neuroimaging.io): one file per participant and
scenario. Familiarization trials come first; `trial_type` distinguishes them from the test.
Participants without any answer have no file and are not listed. `phenotype/questions.tsv`, if the
lab asks questions of its own, has their answers."""


def readme(
    study: Study,
    layout: Literal["export", "psych-ds", "bids"],
    facts: Mapping[str, Any] | None = None,
) -> str:
    """Return the README.md of the export, or of its Psych-DS or BIDS folder.

    ``facts``, if given, are the counts of `ExportReport.facts`, which are appended.
    """
    files = _FILES
    if study.blocks.all_scenarios:
        files = files.replace("the test stimuli by scenario", "the test stimuli of each session")
    special = {"export": files, "psych-ds": _PSYCH_DS, "bids": _BIDS}[layout]
    rule = RULE if layout != "bids" else f"{TEXT_RULE}. {RULE}"
    parts = [
        f"# {study.title}",
        f"Study {study.name}, version {study.version}. Contact: {study.contact}",
        _TASK + _structure(study),
        special,
        _PEOPLE,
        fill(rule, 100),
    ]
    if facts is not None:
        parts.append("## Counts\n\n" + "\n".join(count_lines(facts, "- ")))
    return "\n\n".join(parts) + "\n"


def _structure(study: Study) -> str:
    """Return the description of a session."""
    if not study.blocks.all_scenarios:
        return _ONE_SCENARIO
    return _BLOCKS.format(practice=_PRACTICE[study.blocks.familiarization])


def count_lines(facts: Mapping[str, Any], bullet: str = "") -> list[str]:
    """Return the counts of `ExportReport.facts` as lines of text."""
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
