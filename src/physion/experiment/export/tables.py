"""The tables of an export, read from the database: columns, and rows as Arrow tables.

Columns of trials and sessions are defined in `physion.analysis.people.responses`, of the other
tables here. Sessions are sorted by start time; trials by session, then familiarization
before test, in the order in which they were shown. Labels are read from the study folder. Sessions
that are left out are counted by reason (`SessionTable.left_out`).
"""

from __future__ import annotations

import contextlib
import json
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
from sqlalchemy import Connection, Engine, select

from physion.analysis.people.responses import SESSION_COLUMNS, TRIAL_COLUMNS
from physion.core.errors import PhysionError, UnknownNameError
from physion.core.tables import Column
from physion.experiment.store.database import ANSWERS, EVENTS, PRACTICE_REPEATS, SESSIONS, STUDIES
from physion.experiment.store.sessions import end_of
from physion.experiment.study.orders import instructed_response
from physion.experiment.study.settings import Question, columns_of
from physion.experiment.study.stimuli import ATTENTION, PHASES, is_right
from physion.experiment.study.stimuli import COLUMNS as ALL_STIMULI_COLUMNS
from physion.experiment.study.study import Study

# --- columns as Arrow types and data frames ---

ARROW_TYPES = {
    "text": pa.string(),
    "choice": pa.string(),
    "time": pa.string(),
    "integer": pa.int64(),
    "number": pa.float64(),
    "flag": pa.bool_(),
}


def arrow_schema(columns: Sequence[Column]) -> pa.Schema:
    """Return the Arrow (and parquet) schema of the columns."""
    return pa.schema([pa.field(column.name, ARROW_TYPES[column.kind]) for column in columns])


def as_frame(table: pa.Table, columns: Sequence[Column]) -> pd.DataFrame:
    """Convert an Arrow table to a data frame with the types of `tables.check_table`."""
    nullable = {pa.int64(): pd.Int64Dtype(), pa.bool_(): pd.BooleanDtype()}
    frame = table.to_pandas(types_mapper=nullable.get)
    typed = {}
    for column in columns:
        values = frame[column.name]
        if ARROW_TYPES[column.kind] == pa.string():
            values = values.astype("str").fillna("")
        elif column.kind == "flag" and not column.may_be_empty:
            values = values.astype(bool)
        typed[column.name] = values
    return pd.DataFrame(typed)


# --- answers to the lab's own questions: one row per session that sent them ---
#
# Columns are the questions of all versions of the study that were served; the latest texts
# describe them. A question with any number of options has one column for each option.

KEYS: tuple[Column, ...] = (
    Column("participant", "text", "As in the sessions", required=True, may_be_empty=False),
    Column("session", "text", "As in the sessions", required=True, may_be_empty=False),
)


def read_questions(
    connection: Connection, study: Study
) -> list[tuple[Question, Mapping[str, str]]]:
    """Return the questions of all served versions and of now, each with its latest texts by key.

    Options of earlier versions are kept.
    """
    rows = connection.execute(select(STUDIES.c.settings, STUDIES.c.first_served, STUDIES.c.digest))
    asked = [
        (Question(**{**entry, "options": tuple(entry["options"])}), settings)
        for settings, *_ in sorted(rows, key=lambda row: (row.first_served, row.digest))
        for entry in settings.get("questions", ())
    ]
    asked += [(question, vars(study)) for question in study.questions]
    found: dict[str, tuple[Question, Mapping[str, str]]] = {}
    for question, settings in asked:
        texts = settings["texts"][settings["languages"][0]]
        if question.name in found:
            before, older_texts = found[question.name]
            options = tuple(dict.fromkeys((*before.options, *question.options)))
            question, texts = replace(question, options=options), {**older_texts, **texts}
        found[question.name] = (question, texts)
    return list(found.values())


def question_columns(
    questions: Sequence[tuple[Question, Mapping[str, str]]],
) -> tuple[Column, ...]:
    """Return the described columns of the answers to these questions."""
    return tuple(column for question, texts in questions for column in _columns(question, texts))


def _columns(question: Question, texts: Mapping[str, str]) -> list[Column]:
    """Return the columns of one question, described by its texts."""
    key = f"question.{question.name}"
    words = " ".join(texts[f"{key}.text"].split())
    labels = {option: texts[f"{key}.options.{option}"] for option in question.options}
    match question.kind:
        case "text":
            return [Column(question.name, "text", words)]
        case "scale":
            ends = f"1: {texts[f'{key}.low']}, {question.steps}: {texts[f'{key}.high']}"
            about = f"{words} ({ends})"
            return [Column(question.name, "integer", about, low=1, high=question.steps)]
        case "choice":
            named = "; ".join(f"{option}: {label}" for option, label in labels.items())
            about = f"{words} ({named})"
            found = [Column(question.name, "choice", about, choices=question.options)]
            if question.right:
                correct = (
                    f"Was the answer to this question {question.right}, which is right? {words}"
                )
                found.append(Column(f"{question.name}_right", "flag", correct))
            return found
    names = zip(columns_of(question), labels.values(), strict=True)
    return [Column(name, "flag", f"{words} Was chosen: {label}") for name, label in names]


def read_own_answers(
    connection: Connection,
    questions: Sequence[tuple[Question, Mapping[str, str]]],
    sessions: pa.Table,
) -> pa.Table:
    """Return the table of answers of these exported sessions, in their order."""
    query = select(SESSIONS.c.session, SESSIONS.c.own_answers)
    rows = connection.execute(query.where(SESSIONS.c.questions_at.is_not(None)))
    given: dict[str, Mapping[str, Any]] = {session: answers or {} for session, answers in rows}
    found = []
    for keys in sessions.select(["participant", "session"]).to_pylist():
        if keys["session"] in given:
            answers = given[keys["session"]]
            found.append(
                {k: v for question, _ in questions for k, v in _cells(question, answers).items()}
                | keys
            )
    return _as_table(found, (*KEYS, *question_columns(questions)))


def _cells(question: Question, answers: Mapping[str, Any]) -> dict[str, Any]:
    """Return the cells of one question by column; None where it was not asked or not answered."""
    answer = answers.get(question.name)
    if question.kind != "choices":
        right = None if answer is None else answer == question.right
        given = {question.name: answer}
        return given | ({f"{question.name}_right": right} if question.right else {})
    names = zip(columns_of(question), question.options, strict=True)
    return {name: None if answer is None else option in answer for name, option in names}


def iso_times(seconds: npt.NDArray[np.float64]) -> pa.Array:
    """Format Unix times (UTC, in the years 1000 to 9999) as ``2026-01-31T09:30:00.123Z``.

    Milliseconds are truncated; NaN becomes null.
    """
    known = np.isfinite(seconds)
    milliseconds = np.floor(np.where(known, seconds, 0.0) * 1000).astype(np.int64)
    moments = pa.array(milliseconds, pa.timestamp("ms"), mask=~known)
    return pc.strftime(moments, format="%Y-%m-%dT%H:%M:%SZ")


EXPORTED_KINDS = ("person", "simulated")
"""Kinds of sessions that can be exported; previews cannot."""
PREVIEW = "preview by the experimenter"
VOID = "the experimenter made the session void"
WITHDRAWN = "the participant withdrew"
OTHER_KIND = "{kind}, which was not requested"
GONE_SCENARIO = "of {scenario}, which study.toml no longer has: add it again to export them"
OTHER_SCENARIO = "of a scenario that was not requested"
_Row = Any
"""A row of sessions with name and version of the study (its exact type would list all columns)."""


@dataclass(frozen=True)
class SessionSelection:
    """Which sessions to export: kinds, and one scenario (None: all)."""

    kinds: Sequence[str] = EXPORTED_KINDS
    scenario: str | None = None


@dataclass(frozen=True)
class SessionTable:
    """The exported sessions, and counts of those left out.

    Attributes
    ----------
    table
        One row per session; empty cells are null.
    states
        Number of sessions in the table by kind and ``finished`` or ``unfinished``.
    left_out
        Number of sessions left out, by kind and reason.
    studies
        Digests of the versions of the study under which the sessions of the table ran.
    """

    table: pa.Table
    states: Counter[tuple[str, str]]
    left_out: Counter[tuple[str, str]]
    studies: tuple[str, ...]


def read_sessions(
    connection: Connection, study: Study, wanted: SessionSelection = SessionSelection()
) -> SessionTable:
    """Read the selected sessions, sorted by start time; count the others by reason."""
    for kind in wanted.kinds:
        if kind not in EXPORTED_KINDS:
            raise UnknownNameError("kind of session", kind, EXPORTED_KINDS)
    if wanted.scenario is not None and wanted.scenario not in study.scenarios:
        raise UnknownNameError("scenario", wanted.scenario, study.scenarios)
    query = select(*SESSIONS.c, STUDIES.c.name, STUDIES.c.version).join(
        STUDIES, STUDIES.c.digest == SESSIONS.c.study
    )
    kept: list[_Row] = []
    states: Counter[tuple[str, str]] = Counter()
    left_out: Counter[tuple[str, str]] = Counter()
    for row in connection.execute(query):
        reason = _why_not(row, wanted, study)
        if reason is not None:
            left_out[row.kind, reason] += 1
            continue
        kept.append(row)
        states[row.kind, "unfinished" if row.finished_at is None else "finished"] += 1
    # Sorted here because databases differ in how they order text.
    kept.sort(key=lambda row: (row.started_at, row.session))
    digests = tuple(dict.fromkeys(row.study for row in kept))
    cells = [
        {column.name: _session_value(row, column.name) for column in SESSION_COLUMNS}
        for row in kept
    ]
    return SessionTable(_as_table(cells, SESSION_COLUMNS), states, left_out, digests)


def _why_not(row: _Row, wanted: SessionSelection, study: Study) -> str | None:
    """Return the reason why a session is left out, or None if it is exported."""
    if row.kind not in EXPORTED_KINDS:
        return PREVIEW
    if row.kind not in wanted.kinds:
        return OTHER_KIND.format(kind=row.kind)
    if wanted.scenario not in (None, row.scenario):
        return OTHER_SCENARIO
    end = end_of(row)
    if end == "void":
        return VOID
    if end == "withdrawn":
        return WITHDRAWN
    if row.scenario not in study.scenarios:
        return GONE_SCENARIO.format(scenario=row.scenario)
    return None


def _session_value(row: _Row, name: str) -> Any:
    """Return the value of one exported column; None for an empty cell."""
    match name:
        case "simulated":
            return row.kind == "simulated"
        case "study":
            return f"{row.name} {row.version}"
        case "screened_out":
            return row.screened_out_by
        case "recruited_by":
            return row.source
        case "user_agent" | "refresh_hz" | "screen_width" | "screen_height":
            return row.device.get(name)
        case "pixel_ratio" | "touch":
            return row.device.get(name)
    value = getattr(row, name)
    return None if value == "" else value


# --- answers, read in batches of sessions to bound the memory ---

AT_ONCE = 200
"""Number of sessions whose answers are fetched in one query."""


@dataclass(frozen=True)
class TrialBatch:
    """Answers of consecutive sessions.

    Attributes
    ----------
    table
        One row per answer.
    details
        Measured details of each row as JSON text.
    unknown
        Stimulus of each answer that was left out because the study folder no longer has it.
    """

    table: pa.Table
    details: pa.Array
    unknown: tuple[str, ...]


def read_trials(connection: Connection, study: Study, sessions: pa.Table) -> Iterator[TrialBatch]:
    """Yield the answers of a batch of sessions at a time, in the order of ``sessions``.

    Parameters
    ----------
    connection
        Connection of `snapshot`.
    study
        The study, for the labels of its stimuli.
    sessions
        Table of `read_sessions`.
    """
    stimuli = {(s.scenario, s.stimulus): s for s in study.stimuli}
    names = ["participant", "session", "simulated", "buttons", "condition", "scenario"]
    listed = sessions.select(names).to_pylist()
    for first in range(0, len(listed), AT_ONCE):
        chosen = {each["session"]: each for each in listed[first : first + AT_ONCE]}
        ranks = {name: rank for rank, name in enumerate(chosen)}
        wanted = ANSWERS.c.session.in_(chosen), ANSWERS.c.phase.in_(PHASES)
        kept: list[tuple[tuple[int, ...], dict[str, Any]]] = []
        unknown: list[str] = []
        for row in connection.execute(select(ANSWERS).where(*wanted)).mappings():
            session = chosen[row["session"]]
            stimulus = stimuli.get((session["scenario"], row["stimulus"]))
            if stimulus is None:
                unknown.append(row["stimulus"])
                continue
            cells = {
                **row,
                **session,
                "label": stimulus.label,
                "correct": is_right(row["response"], stimulus.label),
                "look": stimulus.look,
            }
            place = ranks[row["session"]], PHASES.index(row["phase"]), row["trial"]
            kept.append((place, cells))
        kept.sort(key=lambda entry: entry[0])
        rows = [cells for _, cells in kept]
        details = pa.array([cells["details"] for cells in rows], pa.string())
        yield TrialBatch(_as_table(rows, TRIAL_COLUMNS), details, tuple(unknown))


def _as_table(rows: Sequence[Mapping[str, Any]], columns: Sequence[Column]) -> pa.Table:
    """Return the exported table of these rows; moments are seconds since 1970."""
    arrays = []
    for column in columns:
        values = [cells[column.name] for cells in rows]
        if column.kind == "time":
            arrays.append(iso_times(np.array(values, dtype=np.float64)))
        else:
            arrays.append(pa.array(values, ARROW_TYPES[column.kind]))
    return pa.table(arrays, schema=arrow_schema(columns))


# --- browser events, measured details of trials, and stimuli ---

_SESSION = Column("session", "text", "As in the sessions", required=True, may_be_empty=False)

STIMULI_COLUMNS = tuple(
    column
    for column in ALL_STIMULI_COLUMNS
    if column.name not in ("movie", "map", "full", "full_frames")
)
"""Columns of ``stimuli``: one row per stimulus."""

EVENT_COLUMNS: tuple[Column, ...] = (
    _SESSION,
    Column("number", "integer", "Index among the events of the session, from 0", low=0,
           required=True, may_be_empty=False),
    Column("kind", "text", "What happened: hidden, visible, offline, online, error, resized, ..."),
    Column("at_ms", "number", "Time since the page was opened, by the browser's clock", unit="ms",
           low=0),
    Column("stored_at", "time", "Time when the server stored it"),
    Column("data", "text", "Further data of the event, as a JSON object"),
)  # fmt: skip
"""Columns of ``events``: one row per event of a session."""

DETAIL_COLUMNS: tuple[Column, ...] = (
    _SESSION,
    Column("phase", "choice", "As in the trials", choices=PHASES, required=True,
           may_be_empty=False),
    Column("trial", "integer", "As in the trials", low=0, required=True, may_be_empty=False),
    Column(
        "details", "text",
        "JSON object of further measurements; times in ms from the start of the trial. flashes: "
        "times at which the cue was switched on and off; frames: for each presented frame its "
        "time, its index in the movie from 0, and the number of frames presented so far; play_ms: "
        "time that the movie took to start; ended_ms, enabled_ms: times of the end of the movie "
        "and of enabling the buttons; visibility: times at which the page was hidden or shown; "
        "shown_width, shown_height: size of the movie in CSS pixels; attempts: number of times "
        "the trial was started",
    ),
)  # fmt: skip
"""Columns of ``trial_details``: one row per trial."""


def read_events(connection: Connection, sessions: pa.Table) -> Iterator[pa.Table]:
    """Yield tables of the events of some sessions at a time, in the order of ``sessions``."""
    names = sessions.column("session").to_pylist()
    for first in range(0, len(names), AT_ONCE):
        chosen: dict[str, list[dict[str, Any]]] = {
            name: [] for name in names[first : first + AT_ONCE]
        }
        query = select(EVENTS).where(EVENTS.c.session.in_(chosen)).order_by(EVENTS.c.event)
        for row in connection.execute(query).mappings():
            data = json.dumps(row["data"], sort_keys=True, ensure_ascii=False)
            events = chosen[row["session"]]
            events.append({**row, "number": len(events), "data": data})
        yield _as_table([event for events in chosen.values() for event in events], EVENT_COLUMNS)


def detail_table(trials: TrialBatch) -> pa.Table:
    """Return the table of details of trials."""
    keys = [trials.table.column(name) for name in ("session", "phase", "trial")]
    return pa.table([*keys, trials.details], schema=arrow_schema(DETAIL_COLUMNS))


# --- answers that are not trials of the analysis ---
#
# Attention checks, and practice trials that were repeated afterwards.

_NAMES = ("participant", "session", "stimulus", "trial", "response", "label", "correct", "rt_ms",
          "input", "frames_shown", "void", "answered_at")  # fmt: skip
_AS_TRIALS = tuple(
    replace(column, about=f"{column.about}; as in the trials")
    for column in TRIAL_COLUMNS
    if column.name in _NAMES
)
REPEAT_COLUMNS: tuple[Column, ...] = (
    *_AS_TRIALS,
    Column("repeat", "integer", "How often the practice had been repeated before",
           low=0, required=True, may_be_empty=False),
)  # fmt: skip
"""One row per answer to a practice trial that was repeated afterwards."""
ATTENTION_COLUMNS: tuple[Column, ...] = (
    *_AS_TRIALS,
    Column("instructed", "flag", "The page said which button to press; label is True for yes",
           required=True, may_be_empty=False),
)  # fmt: skip
"""One row per answer to an attention check."""


def read_practice_repeats(connection: Connection, study: Study, sessions: pa.Table) -> pa.Table:
    """Return the answers of these sessions to practice trials that were repeated afterwards."""
    rows = connection.execute(select(PRACTICE_REPEATS).order_by(PRACTICE_REPEATS.c.repeat))
    return _table(rows, study, sessions, REPEAT_COLUMNS)


def read_attention(connection: Connection, study: Study, sessions: pa.Table) -> pa.Table:
    """Return the answers of these sessions to attention checks."""
    rows = connection.execute(select(ANSWERS).where(ANSWERS.c.phase == ATTENTION))
    return _table(rows, study, sessions, ATTENTION_COLUMNS)


def _table(
    rows: Iterable[Any], study: Study, sessions: pa.Table, columns: Sequence[Column]
) -> pa.Table:
    """Return the exported table of these answers, in the order of the sessions.

    Answers of other sessions, and to stimuli that the study no longer has, are left out.
    """
    names = ("session", "participant", "scenario")
    keys = zip(*(sessions.column(name).to_pylist() for name in names), strict=True)
    places = {
        session: (at, person, scenario) for at, (session, person, scenario) in enumerate(keys)
    }
    labels = study.labels
    kept: list[tuple[tuple[int, int, int], dict[str, Any]]] = []
    for row in rows:
        if row.session not in places:
            continue
        at, person, scenario = places[row.session]
        asked = instructed_response(row.stimulus) if row.phase == ATTENTION else None
        label = labels.get((scenario, row.stimulus)) if asked is None else asked == "yes"
        if label is None:
            continue
        repeat = getattr(row, "repeat", 0)
        cells = row._asdict() | {
            "participant": person,
            "label": label,
            "correct": is_right(row.response, label),
            "instructed": asked is not None,
        }
        kept.append(((at, repeat, row.trial), cells))
    kept.sort(key=lambda entry: entry[0])
    return _as_table([cells for _, cells in kept], columns)


# --- the data of a study as two data frames ---


def read_tables(engine: Engine, study: Study) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Read trials and sessions from one consistent snapshot of the database.

    Sessions without consent and of participants who withdrew are left out. ``study``: for the
    labels of its stimuli.

    Returns
    -------
    tuple of DataFrame
        Trials and sessions, with the types of `tables.check_table`.

    Raises
    ------
    PhysionError
        There are answers to stimuli that the study folder no longer has.
    """
    with snapshot(engine) as connection:
        sessions = read_sessions(connection, study)
        parts = list(read_trials(connection, study, sessions.table))
    unknown = [name for part in parts for name in part.unknown]
    if unknown:
        raise PhysionError(
            f"{len(unknown)} answers are to stimuli that {study.folder} no longer has, the first "
            f"to {unknown[0]}; restore them in stimuli.csv"
        )
    empty = arrow_schema(TRIAL_COLUMNS).empty_table()
    trials = pa.concat_tables([empty, *(part.table for part in parts)])
    return as_frame(trials, TRIAL_COLUMNS), as_frame(sessions.table, SESSION_COLUMNS)


@contextlib.contextmanager
def snapshot(engine: Engine) -> Iterator[Connection]:
    """Open a read connection that sees the database as of its first query, despite later writes."""
    with engine.connect() as connection, connection.begin():
        yield connection
