"""The exported table of answers to the lab's own questions: one row per session that sent them.

Columns are the questions of all versions of the study that were served; the latest texts describe
them. A question with any number of options has one column for each option.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import pyarrow as pa
from sqlalchemy import Connection, select

from physion.analysis.people.responses import Column
from physion.experiment.export.arrow_types import ARROW_TYPES, arrow_schema
from physion.experiment.store.database import SESSIONS, STUDIES
from physion.experiment.study.settings import Question, columns_of
from physion.experiment.study.study import Study

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
            told = "; ".join(f"{option}: {label}" for option, label in labels.items())
            about = f"{words} ({told})"
            return [Column(question.name, "choice", about, choices=question.options)]
    names = zip(columns_of(question), labels.values(), strict=True)
    return [Column(name, "flag", f"{words} Was chosen: {label}") for name, label in names]


def read_own_answers(
    connection: Connection,
    questions: Sequence[tuple[Question, Mapping[str, str]]],
    sessions: pa.Table,
) -> pa.Table:
    """Return the table of answers of these exported sessions, in their order."""
    columns = (*KEYS, *question_columns(questions))
    query = select(SESSIONS.c.session, SESSIONS.c.own_answers)
    rows = connection.execute(query.where(SESSIONS.c.questions_at.is_not(None)))
    given: dict[str, Mapping[str, Any]] = {session: answers or {} for session, answers in rows}
    values: dict[str, list[Any]] = {column.name: [] for column in columns}
    pairs = (sessions.column(name).to_pylist() for name in ("participant", "session"))
    for participant, session in zip(*pairs, strict=True):
        if session not in given:
            continue
        values["participant"].append(participant)
        values["session"].append(session)
        for question, _ in questions:
            for name, cell in _cells(question, given[session]).items():
                values[name].append(cell)
    arrays = [pa.array(values[column.name], ARROW_TYPES[column.kind]) for column in columns]
    return pa.table(arrays, schema=arrow_schema(columns))


def _cells(question: Question, answers: Mapping[str, Any]) -> dict[str, Any]:
    """Return the cells of one question by column; None where it was not asked or not answered."""
    answer = answers.get(question.name)
    if question.kind != "choices":
        return {question.name: answer}
    names = zip(columns_of(question), question.options, strict=True)
    return {name: None if answer is None else option in answer for name, option in names}
