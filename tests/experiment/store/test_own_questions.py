"""Answers to the lab's own questions: stored, exported and forgotten."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from sqlalchemy import inspect

from physion.core.errors import BadInputError
from physion.experiment.export.descriptions import restore_cell
from physion.experiment.export.export_study import export_study
from physion.experiment.protocol import PageDone
from physion.experiment.store.database import SESSIONS
from physion.experiment.store.lab import forget_sessions
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.settings import Question
from physion.experiment.study.study import Study, load_study, write_settings
from physion.experiment.study.texts import shipped_file
from support.experiment.own_questions import OWN_ANSWERS, OWN_QUESTIONS, OWN_TEXTS
from support.experiment.store_walk import begin, enter, open_store, page, refusal, rows, run, walk
from support.experiment.tiny_study import make_tiny_study


@pytest.fixture
def asking(tmp_path: Path) -> Study:
    return make_tiny_study(
        tmp_path / "study", test=2, familiarization=1, scenarios=("collide", "drop"), size=64,
        demographics=False, questions=OWN_QUESTIONS, more_texts=OWN_TEXTS,
    )  # fmt: skip


@pytest.fixture
def asking_store(asking: Study, database: Path) -> Iterator[Store]:
    opened = open_store(asking, Secrets.load(asking.folder), database)
    yield opened
    opened.close()


def test_own_questions_come_in_place_of_demographics(asking_store: Store) -> None:
    store = asking_store
    token = walk(store, enter(store, "Ada", scenario="drop"), "questions")
    bad = PageDone(page="questions", data=OWN_ANSWERS | {"confidence": 9})
    assert "confidence" in str(refusal(store.page(token, bad)))
    assert run(store.state(token)).stage == "questions"
    assert page(store, token, "questions").stage == "feedback"
    again = {**OWN_ANSWERS, "games": "never"}
    assert page(store, token, "questions", **again).stage == "feedback"
    (session,) = rows(store, SESSIONS)
    assert session.own_answers == OWN_ANSWERS | {"devices": ["phone", "computer"]}
    assert session.questions_at is not None and session.demographics_at is None
    assert page(store, token, "feedback").stage == "done"


def test_a_study_without_questions_has_no_such_page(store: Store) -> None:
    token = walk(store, enter(store, "Ada", scenario="drop"), "demographics")
    assert "no question" in str(refusal(store.page(token, PageDone(page="questions",
                                                                   data=OWN_ANSWERS))))  # fmt: skip
    assert page(store, token, "demographics").stage == "feedback"


def test_answers_are_exported_with_their_words(asking_store: Store, tmp_path: Path) -> None:
    store = asking_store
    for scenario in ("collide", "drop"):
        walk(store, enter(store, "Ada", scenario=scenario), "done")
    walk(store, enter(store, "Bo", scenario="drop"), "questions")
    out = export_study(store.engine, store.study, tmp_path / "out").out
    table = pd.read_csv(out / "questions.csv")
    columns = ["strategy", "games", "devices_phone", "devices_console", "devices_computer",
               "confidence"]  # fmt: skip
    assert list(table.columns) == ["participant", "session", *columns] and len(table) == 2
    first = table.iloc[0]
    assert restore_cell(first["strategy"]) == OWN_ANSWERS["strategy"] != first["strategy"]
    assert [first[name] for name in columns[1:]] == ["often", True, False, True, 4]
    assert set(table["session"]) <= set(pd.read_csv(out / "sessions.csv")["session"])
    described = json.loads((out / "data_dictionary.json").read_text())["questions"]
    assert [column["name"] for column in described] == list(table.columns)
    (scale,) = (column for column in described if column["name"] == "confidence")
    assert scale["about"] == "How sure were you? (1: Not at all, 5: Very)" and scale["high"] == 5
    psych = json.loads((out / "psych-ds" / "dataset_description.json").read_text())
    assert set(columns) <= {each["name"] for each in psych["variableMeasured"]}
    assert len(list((out / "psych-ds" / "data").glob("*questions_data.csv"))) == 1


def test_answers_are_forgotten(asking: Study, tmp_path: Path) -> None:
    url = tmp_path / "a"
    store = open_store(asking, Secrets.load(asking.folder), url)
    token = walk(store, begin(store, "Ada", scenario="drop"), "done")
    reference = run(store.state(token)).reference
    store.close()
    assert b"I looked" in (url / "responses.sqlite").read_bytes()
    forget_sessions(url, [reference])
    assert b"I looked" not in (url / "responses.sqlite").read_bytes()
    store = open_store(asking, Secrets.load(asking.folder), url)
    (session,) = rows(store, SESSIONS)
    assert (session.own_answers, session.questions_at) == (None, None)
    store.close()


def test_an_answered_question_keeps_its_form(asking: Study, tmp_path: Path) -> None:
    url, secrets = tmp_path / "a", Secrets.load(asking.folder)

    def serve_with(*questions: Question) -> Store:
        write_settings(replace(asking, questions=questions))
        return open_store(load_study(asking.folder), secrets, url)

    serve_with(replace(OWN_QUESTIONS[3], steps=7), *OWN_QUESTIONS[:3]).close()  # nobody answered
    store = serve_with(*OWN_QUESTIONS)
    walk(store, enter(store, "Ada", scenario="drop"), "done")
    store.close()
    with pytest.raises(BadInputError, match="confidence was answered in another form"):
        serve_with(replace(OWN_QUESTIONS[3], steps=7), *OWN_QUESTIONS[:3])
    for language in asking.languages:
        words = OWN_TEXTS.split("[question.games]")[1].split("[question.devices]")[0]
        path = asking.folder / "texts" / f"{language}.toml"
        path.write_bytes(shipped_file(language) + f"[question.games]{words}".encode())
    store = serve_with(OWN_QUESTIONS[1])  # the others are asked no more, and still exported
    table = pd.read_csv(export_study(store.engine, store.study, tmp_path / "out").out
                        / "questions.csv")  # fmt: skip
    assert table["confidence"].tolist() == [4]
    assert "own_answers" in {c["name"] for c in inspect(store.engine).get_columns("sessions")}
    store.close()
