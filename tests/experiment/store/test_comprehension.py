"""The comprehension check: instructions once more, the end after too many attempts, the data."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from physion.experiment.export.export_study import export_study
from physion.experiment.protocol import Completion, PageDone
from physion.experiment.store.answering import ATTEMPT
from physion.experiment.store.database import EVENTS, SESSIONS
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.settings import Comprehension, EarlyEnd
from physion.experiment.study.study import Study
from physion.experiment.web.api import public_study
from support.experiment.own_questions import COMPREHENSION, COMPREHENSION_TEXTS, RIGHT, WRONG
from support.experiment.store_walk import enter, open_store, page, refusal, request, rows, run, walk
from support.experiment.tiny_study import make_tiny_study


@pytest.fixture
def checking(tmp_path: Path) -> Study:
    return make_tiny_study(
        tmp_path / "study", test=2, familiarization=1, scenarios=("collide", "drop"), size=64,
        comprehension_questions=COMPREHENSION, more_texts=COMPREHENSION_TEXTS, participants=1,
        comprehension=Comprehension(attempts=2),
        screened_out=EarlyEnd("SCREENED", "screened", "https://lab.example/out"),
    )  # fmt: skip


@pytest.fixture
def checking_store(checking: Study, database: Path) -> Iterator[Store]:
    opened = open_store(checking, Secrets.load(checking.folder), database)
    yield opened
    opened.close()


def test_a_wrong_answer_shows_the_instructions_again(checking_store: Store) -> None:
    store = checking_store
    token = walk(store, enter(store, "Ada", scenario="drop"), "comprehension")
    unfit = PageDone(page="comprehension", data={"task": "touch"})
    assert refusal(store.page(token, unfit)).code == "bad_request"
    state = page(store, token, "comprehension", **WRONG)
    assert (state.stage, state.comprehension_attempts) == ("instructions", 1)
    # The same attempt, sent once more since its response was lost, counts once.
    again = refusal(store.page(token, PageDone(page="comprehension", data=WRONG)))
    assert (again.code, again.state) == ("wrong_stage", state)
    page(store, token, "instructions")
    state = page(store, token, "comprehension", **RIGHT)
    assert (state.stage, state.comprehension_attempts) == ("familiarization", 2)
    attempts = [row.data for row in rows(store, EVENTS) if row.kind == ATTEMPT]
    assert attempts == [
        {"attempt": 1, "right": False, **WRONG}, {"attempt": 2, "right": True, **RIGHT},
    ]  # fmt: skip
    walk(store, token, "done")


def test_after_the_last_attempt_the_session_has_ended(checking_store: Store) -> None:
    store = checking_store
    token = walk(store, enter(store, "Ada", scenario="drop"), "comprehension")
    page(store, token, "comprehension", **WRONG)
    page(store, token, "instructions")
    state = page(store, token, "comprehension", **WRONG)
    assert (state.stage, state.ended) == ("screened_out", True)
    ending = store.ending(token)
    assert ending.completion == Completion(code="screened", url="https://lab.example/out")
    (session,) = rows(store, SESSIONS)
    assert session.screened_out_by == "comprehension" and session.finished_at is None
    # The same person begins nothing else, and the place is free.
    for scenario in ("drop", "collide", None):
        back = run(store.enter(request("Ada", scenario=scenario)))
        assert back.state.stage == "screened_out"
    walk(store, enter(store, "Bo", scenario="drop"), "done")


def test_right_answers_are_not_sent(checking: Study) -> None:
    sent = public_study(checking, Secrets.load(checking.folder)).model_dump_json()
    assert '"comprehension_questions":[{"name":"task","options":["fall","touch"]}' in sent
    swapped = tuple(replace(each, right=each.options[0]) for each in COMPREHENSION)
    other = replace(checking, comprehension_questions=swapped)
    assert public_study(other, Secrets.load(checking.folder)).model_dump_json() == sent


def test_attempts_and_ends_are_exported(checking_store: Store, tmp_path: Path) -> None:
    store = checking_store
    walk(store, enter(store, "Ada", scenario="drop"), "done")
    token = enter(store, "Bo", scenario="collide")
    for _ in range(2):
        page(store, walk(store, token, "comprehension"), "comprehension", **WRONG)
    out = export_study(store.engine, store.study, tmp_path / "out").out
    table = pd.read_csv(out / "sessions.csv").sort_values("scenario")
    assert table["comprehension_attempts"].tolist() == [2, 1]
    assert table["screened_out"].fillna("").tolist() == ["comprehension", ""]
    assert (pd.read_csv(out / "events.csv")["kind"] == ATTEMPT).sum() == 3
