"""Schema of participant-level data, shared by the experiment's export and the analysis.

Two tables make a study's data: one row a participant and trial (`TRIAL_COLUMNS`) and one row a
session (`SESSION_COLUMNS`). The experiment exports exactly these columns and writes its data
dictionary with `data_dictionary`; the analysis refuses a file that violates them and names the row.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
import pandas as pd

from physion.analysis.tables.csv_table import require_columns
from physion.core.errors import BadInputError

Kind = Literal["text", "integer", "number", "flag", "choice", "time"]
"""``text``; whole or any ``number``; ``flag``: True or False; ``choice``: one of ``choices``;
``time``: a moment in ISO 8601 with its offset from UTC."""


@dataclass(frozen=True)
class Column:
    """A column of participant-level data: its meaning and its allowed values.

    ``required``: the column must exist. ``may_be_empty``: a cell may be empty (unknown). The bounds
    ``low`` and ``high`` are inclusive and in ``unit``.
    """

    name: str
    kind: Kind
    about: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    required: bool = False
    may_be_empty: bool = True


PHASES = ("familiarization", "test")
DAY_MS = 86_400_000.0


def _must(name: str, kind: Kind, about: str, **rest: Any) -> Column:
    return Column(name, kind, about, required=True, may_be_empty=False, **rest)


TRIAL_COLUMNS: tuple[Column, ...] = (
    _must("participant", "text", "Keyed hash of the participant's id; never the id itself"),
    _must("session", "text", "One run through the experiment by one participant, unique"),
    _must("scenario", "text", "Scenario of the trial"),
    _must("stimulus", "text", "Name of the trial that was shown"),
    _must("phase", "choice", "With feedback (familiarization) or without (test)", choices=PHASES),
    _must(
        "trial",
        "integer",
        "Place in the order of its phase in the session, from 0; attention "
        "checks, which are not in this table, have places too",
        low=0,
    ),
    Column(
        "response",
        "choice",
        "Will the agent touch the patient? Empty: no answer was given",
        choices=("yes", "no"),
        required=True,
    ),
    _must("label", "flag", "Does the agent touch the patient?"),
    _must("simulated", "flag", "Made by a program for piloting: no person"),
    Column(
        "rt_ms",
        "number",
        "Response time: from the moment the buttons are enabled to the answer",
        unit="ms",
        low=-DAY_MS,
        high=DAY_MS,
        required=True,
    ),
    Column(
        "buttons",
        "choice",
        "The two buttons from left to right",
        choices=("yes-no", "no-yes"),
    ),
    Column("correct", "flag", "response equals label; recomputed, and refused if it contradicts"),
    Column("input", "choice", "How the answer was given", choices=("mouse", "touch", "keyboard")),
    Column("look", "choice", "Colours of the stimulus", choices=("free", "redyellow")),
    Column("fixation_ms", "number", "How long the cross was shown", unit="ms", low=0, high=DAY_MS),
    Column("cue_ms", "number", "How long the first frame was cued", unit="ms", low=0, high=DAY_MS),
    Column("frames_expected", "integer", "Frames of the observed movie", low=0),
    Column("frames_shown", "integer", "Frames that the browser presented", low=0),
    Column("frames_dropped", "integer", "Frames that the browser decoded and dropped", low=0),
    Column("movie_ms", "number", "From the first to the last frame", unit="ms", low=0, high=DAY_MS),
    Column("visibility_changes", "integer", "How often the page was hidden or shown again", low=0),
    Column("window_width", "integer", "Inner width of the window", unit="px", low=0),
    Column("window_height", "integer", "Inner height of the window", unit="px", low=0),
    Column(
        "break_ms",
        "number",
        "Duration of the break before the trial; empty: there was none",
        unit="ms",
        low=0,
        high=DAY_MS,
    ),
    Column("resumed", "flag", "The page was loaded anew while this trial was the next one"),
    Column(
        "showings", "integer", "How often the movie was shown, over all loads of the page", low=0
    ),
    Column(
        "void",
        "choice",
        "What interrupted the movie, so that the answer does not count: the "
        "page was hidden, a dialog open, or the window too small; empty: nothing",
        choices=("hidden", "dialog", "window"),
    ),
    Column("answered_at", "time", "When the server stored the answer"),
    Column(
        "block",
        "integer",
        "Index of the block in a session of several scenarios, from 0; empty: a session of one",
        low=0,
    ),
    Column("condition", "text", "Between-subject condition of the session; empty: there is none"),
)
"""One row a participant and trial."""

SESSION_COLUMNS: tuple[Column, ...] = (
    _must("participant", "text", "As in the trials"),
    _must("session", "text", "As in the trials; unique here"),
    _must("scenario", "text", "Scenario of the session; several, one block each, in the order "
          "shown and separated by spaces"),
    _must("simulated", "flag", "As in the trials"),
    Column("study", "text", "Name and version of the study"),
    Column("recruited_by", "text", "Where the participant came from"),
    Column("started_at", "time", "When the session began"),
    Column("finished_at", "time", "When the last page was sent; empty: not finished"),
    Column("consent_version", "text", "Version of the consent text that was agreed to"),
    Column("consented_at", "time", "When it was agreed to"),
    Column("instructed_at", "time", "When the instructions were done"),
    Column("comprehension_attempts", "integer",
           "How often the questions about the instructions were answered", low=0),
    Column("screened_out", "choice", "Which check ended the session early; empty: none did",
           choices=("comprehension", "practice")),
    Column("ready_at", "time", "When the page between practice and test was sent; of the last "
           "block begun, if there are several"),
    Column("buttons", "choice", "The buttons from left to right", choices=("yes-no", "no-yes")),
    Column("language", "text", "Language of the pages"),
    Column("order_number", "integer", "Prepared order of trials, from 1; 0: an order of its own",
           low=0),
    Column("loads", "integer", "How often the page was loaded; more than 1: it was resumed", low=0),
    Column("replayed", "integer", "Trials shown more often than the study allows", low=0),
    Column("implausible", "text", "Why no person can have made the session, as the server judged: "
           "fast answers, no media, short; empty: nothing is wrong"),
    Column("practice_repeats", "integer",
           "How often the practice was repeated; in the last block begun, if there are several",
           low=0),
    Column("attention_failed", "integer", "Number of failed attention checks", low=0),
    Column("failed_checks", "text", "Checks of the lab that the session failed: practice, "
           "attention; empty: none"),
    Column("age", "integer", "Age", unit="years", low=0, high=130),
    Column("gender", "text", "Gender, in the words of the questionnaire"),
    Column("education", "text", "Highest education, in the words of the questionnaire"),
    Column("difficulty", "integer", "How difficult was the task? 1 very easy, 5 very hard",
           low=1, high=5),
    Column("technical_problems", "flag", "Did the participant report technical problems?"),
    Column("feedback", "text", "Free text"),
    Column("user_agent", "text", "Browser and system, as the browser says"),
    Column("refresh_hz", "number", "Refresh rate of the screen", unit="Hz", low=0, high=1000),
    Column("screen_width", "integer", "Width of the screen", unit="px", low=0),
    Column("screen_height", "integer", "Height of the screen", unit="px", low=0),
    Column("pixel_ratio", "number", "Device pixels in one CSS pixel", low=0, high=100),
    Column("touch", "flag", "Does the device have a touch screen?"),
    Column("condition", "text", "Between-subject condition; empty: the study has none"),
)  # fmt: skip
"""One row a session; demographics are asked at its end, so that they are empty in broken ones."""


def data_dictionary(columns: Sequence[Column]) -> list[dict[str, Any]]:
    """Return the columns as plain values for JSON: name, kind, about, unit, low, high, choices,
    ...
    """
    return [{**asdict(column), "choices": list(column.choices)} for column in columns]


def check_table(table: pd.DataFrame, columns: Sequence[Column], where: str) -> pd.DataFrame:
    """Return ``table`` with the types of its ``columns``; columns not in the schema are dropped.

    Cells may be text, as from CSV, or typed, as from parquet. Resulting types: str for text, choice
    and time (empty if unknown), Int64 for integer, float64 (NaN) for number, boolean for flag (bool
    if no cell may be empty). An optional column that is absent stays absent. Raises `BadInputError`
    for a missing column or the first invalid cell.
    """
    require_columns(table, [column.name for column in columns if column.required], where)
    present = [column for column in columns if column.name in table.columns]
    typed = {column.name: _typed(table[column.name], column, where) for column in present}
    return pd.DataFrame(typed, index=table.index).reset_index(drop=True)


def _typed(values: pd.Series, column: Column, where: str) -> pd.Series:
    text = values.astype(object).where(values.notna(), "").astype(str).str.strip()
    empty = text == ""
    if not column.may_be_empty:
        _refuse(empty, text, column, where, "a value")
    match column.kind:
        case "integer" | "number":
            return _numbers(text, empty, column, where)
        case "flag":
            return _flags(text, empty, column, where)
        case "choice":
            text = text.str.lower()
            bad = ~empty & ~text.isin(column.choices)
            _refuse(bad, text, column, where, " or ".join(column.choices))
        case "time":
            moments = pd.to_datetime(
                text.where(~empty), errors="coerce", utc=True, format="ISO8601"
            )
            _refuse(~empty & moments.isna(), text, column, where, "a time in ISO 8601")
        case "text":
            pass
    return text


def _numbers(text: pd.Series, empty: pd.Series, column: Column, where: str) -> pd.Series:
    numbers = pd.to_numeric(text.where(~empty), errors="coerce").astype(np.float64)
    low = -np.inf if column.low is None else column.low
    high = np.inf if column.high is None else column.high
    good = np.isfinite(numbers) & (numbers >= low) & (numbers <= high)
    whole = column.kind == "integer"
    if whole:
        good &= numbers == np.floor(numbers)
    expected = f"a {'whole ' if whole else ''}number from {low:g} to {high:g}"
    _refuse(~empty & ~good, text, column, where, expected)
    return numbers.astype("Int64") if whole else numbers


def _flags(text: pd.Series, empty: pd.Series, column: Column, where: str) -> pd.Series:
    words = {"true": True, "1": True, "1.0": True, "yes": True}
    words |= {"false": False, "0": False, "0.0": False, "no": False}
    flags = text.str.lower().map(words)
    _refuse(~empty & flags.isna(), text, column, where, "True or False")
    return flags.astype("boolean") if column.may_be_empty else flags.astype(bool)


def _refuse(bad: pd.Series, text: pd.Series, column: Column, where: str, expected: str) -> None:
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise BadInputError(
            f"{where}: row {row + 1} of column {column.name!r} holds {text.iloc[row][:80]!r}; "
            f"expected {expected}"
        )
