"""Helpers that run sessions through the store without HTTP, and store fixtures."""

from __future__ import annotations

import asyncio
import hashlib
from collections.abc import Coroutine, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import pytest
from sqlalchemy import select

from physion.experiment import protocol as stages
from physion.experiment.protocol import Answer, AnswerStored, Enter, PageDone, SessionState
from physion.experiment.store.database import ANSWERS
from physion.experiment.store.store import Refused, Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.study import Study
from support.experiment.own_questions import OWN_ANSWERS, RIGHT
from support.experiment.tiny_study import make_tiny_study

T = TypeVar("T")
PAGES: dict[str, dict[str, Any]] = {
    "consent": {"agreed": True},
    "instructions": {},
    "ready": {},
    "demographics": {"age": 31, "gender": "woman", "education": "master"},
    "feedback": {"difficulty": 2, "technical_problems": False, "text": "fine"},
}
OPTIONAL_PAGES: dict[str, dict[str, Any]] = {"comprehension": RIGHT, "questions": OWN_ANSWERS}
"""Pages that a study has by its settings alone."""
ORDER = tuple(stage for stage in stages.STAGES if stage not in stages.ENDED)
STAGES = tuple(stage for stage in ORDER if stage not in OPTIONAL_PAGES)
"""Stages of a study without further settings."""


def run(coroutine: Coroutine[Any, Any, T]) -> T:
    return asyncio.run(coroutine)


def answer(trial: int, phase: Any = "test", key: str | None = None, **more: Any) -> Answer:
    values = {"response": "yes", "rt_ms": 512.5, "input": "mouse", **more}
    return Answer(key=key or f"{phase}-{trial:04d}", phase=phase, trial=trial, **values)


def visit_of(person: str) -> str:
    """Return the key of the one browser of a person."""
    return hashlib.sha256(person.encode("utf-8", "replace")).hexdigest()


def request(person: str | None = None, **more: Any) -> Enter:
    """Return the request of a person, always from the same browser, to enter."""
    visit = {} if person is None else {"visit": visit_of(person)}
    return Enter(id=person, **{**visit, **more})


def enter(store: Store, person: str | None = None, **more: Any) -> str:
    return run(store.enter(request(person, **more))).token


def begin(store: Store, person: str | None = None, **more: Any) -> str:
    """Enter and agree to the consent, so that the session is stored; return its token."""
    token = enter(store, person, **more)
    page(store, token, "consent")
    return token


def give(store: Store, token: str, trial: int, phase: Any = "test", **more: Any) -> AnswerStored:
    return run(store.answer(token, answer(trial, phase, **more)))


def page(store: Store, token: str, name: Any, **data: Any) -> SessionState:
    usual = (PAGES | OPTIONAL_PAGES).get(name, {})
    return run(store.page(token, PageDone(page=name, data=data or usual)))


def walk(store: Store, token: str, stage: str) -> str:
    """Submit pages and "yes" answers until a stage is reached, and return the token."""
    while True:
        state = run(store.state(token))
        if state.stage == stage:
            return token
        assert ORDER.index(state.stage) < ORDER.index(stage)
        if state.trial is None:
            page(store, token, state.stage)
        else:
            give(store, token, state.trial, state.stage)


def refusal(coroutine: Coroutine[Any, Any, Any]) -> Refused:
    with pytest.raises(Refused) as caught:
        run(coroutine)
    return caught.value


def rows(store: Store, table: Any = ANSWERS) -> list[Any]:
    with store.engine.connect() as connection:
        return list(connection.execute(select(table)))


@pytest.fixture(scope="session")
def small_study(tmp_path_factory: pytest.TempPathFactory) -> Study:
    """A study with two scenarios of 3 familiarization and 4 test trials each."""
    folder: Path = tmp_path_factory.mktemp("small") / "study"
    return make_tiny_study(
        folder, test=4, familiarization=3, scenarios=("collide", "drop"), size=64,
        participants=3, percentile_from=2,
    )  # fmt: skip


@pytest.fixture(scope="session")
def small_secrets(small_study: Study) -> Secrets:
    return Secrets.load(small_study.folder)


def open_store(study: Study, secrets: Secrets, folder: Path) -> Store:
    """Open a store whose database is in another folder than the study, made if it is missing."""
    folder.mkdir(exist_ok=True)
    return Store.open(replace(study, folder=folder), secrets)


def opened(study: Study, folder: Path) -> Iterator[Store]:
    """Open a store like `open_store`, with the study's own secrets; close it after the test."""
    store = open_store(study, Secrets.load(study.folder), folder)
    yield store
    store.close()


@pytest.fixture
def database(tmp_path: Path) -> Path:
    """Folder of the database of `store`."""
    folder = tmp_path / "database"
    folder.mkdir()
    return folder


@pytest.fixture
def store(small_study: Study, database: Path) -> Iterator[Store]:
    """A store on an empty database."""
    yield from opened(small_study, database)
