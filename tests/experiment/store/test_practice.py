"""The practice criterion: repeats, the end or a flag after them, and the data; both databases."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from physion.analysis.people.responses import read_responses
from physion.experiment.export.export_study import export_study
from physion.experiment.protocol import Completion, SessionState
from physion.experiment.store.database import ANSWERS, PRACTICE_REPEATS, SESSIONS, SHOWINGS
from physion.experiment.store.lab import forget_sessions
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.orders import trial_order
from physion.experiment.study.settings import Blocks, EarlyEnd, Practice
from physion.experiment.study.study import Study
from support.experiment.store_walk import (
    answer,
    enter,
    give,
    open_store,
    page,
    refusal,
    request,
    rows,
    run,
    walk,
)
from support.experiment.tiny_study import make_tiny_study

PHASE = "familiarization"
# The labels of the three practice trials are contact, none, contact: "yes" is right twice.
RULES = Practice(min_correct=3, repeats=1, failed="end")


@pytest.fixture(scope="module")
def practising(tmp_path_factory: pytest.TempPathFactory) -> Study:
    return make_tiny_study(
        tmp_path_factory.mktemp("study"), test=2, familiarization=3, size=64,
        scenarios=("collide", "drop"), practice=RULES,
        screened_out=EarlyEnd("", "out", ""),
    )  # fmt: skip


@pytest.fixture
def practice_store(practising: Study, database: Path) -> Iterator[Store]:
    opened = open_store(practising, Secrets.load(practising.folder), database)
    yield opened
    opened.close()


def practise(store: Store, token: str, name: str, *responses: str) -> SessionState:
    """Answer the next practice trials; keys begin with ``name``."""
    state = run(store.state(token))
    for response in responses:
        assert state.trial is not None and state.stage == PHASE
        key = f"{name}-{state.trial:06d}"
        state = give(store, token, state.trial, PHASE, response=response, key=key).state
    return state


@pytest.mark.parametrize(
    ("responses", "right"),
    [(("yes", "no", "yes"), 3), (("yes", "yes", "yes"), 2), (("yes", "yes", "no"), 1),
     (("no", "yes", "no"), 0)],
)  # fmt: skip
@pytest.mark.parametrize("needed", [0, 1, 2, 3, 4])
def test_as_many_right_answers_as_needed_pass(
    practising: Study, tmp_path: Path, responses: tuple[str, ...], right: int, needed: int
) -> None:
    """The labels are contact, none, contact; more than there are trials means all of them."""
    study = replace(practising, practice=Practice(needed, 1, "end"))
    store = open_store(study, Secrets.load(study.folder), tmp_path / "a")
    token = walk(store, enter(store, "Ada", scenario="drop"), PHASE)
    state = practise(store, token, "first", *responses)
    passed = right >= min(needed, 3)
    assert (state.stage, state.practice_repeats) == (("ready", 0) if passed else (PHASE, 1))
    assert len(rows(store, PRACTICE_REPEATS)) == (0 if passed else 3)
    store.close()


@pytest.mark.parametrize("repeats", [0, 1, 3])
def test_a_practice_is_repeated_as_often_as_the_study_says(
    practising: Study, tmp_path: Path, repeats: int
) -> None:
    study = replace(practising, practice=Practice(3, repeats, "end"))
    store = open_store(study, Secrets.load(study.folder), tmp_path / "a")
    token = walk(store, enter(store, "Ada", scenario="drop"), PHASE)
    for number in range(repeats):
        state = practise(store, token, f"repeat{number}", "no", "no", "no")
        assert (state.stage, state.practice_repeats, state.ended) == (PHASE, number + 1, False)
    state = practise(store, token, "the-last", "no", "no", "no")
    assert (state.stage, state.ended) == ("screened_out", True)
    kept = rows(store, PRACTICE_REPEATS)
    assert [(row.repeat, row.trial) for row in kept] == [
        (repeat, trial) for repeat in range(repeats) for trial in range(3)
    ]
    store.close()


def test_the_practice_is_repeated_and_then_passed(practice_store: Store) -> None:
    store = practice_store
    token = walk(store, enter(store, "Ada", scenario="drop"), PHASE)
    state = practise(store, token, "first", "yes", "yes", "yes")
    assert (state.stage, state.trial, state.practice_repeats) == (PHASE, 0, 1)
    # An answer of the first practice, sent once more, gets its feedback and changes nothing.
    again = give(store, token, 2, PHASE, response="yes", key="first-000002")
    assert again.duplicate and again.feedback is not None and again.feedback.correct
    assert run(store.state(token)) == state
    other = answer(1, PHASE, key="another-key")
    assert refusal(store.answer(token, other)).code == "out_of_order"
    state = practise(store, token, "second", "yes", "no", "yes")
    assert (state.stage, state.practice_repeats) == ("ready", 1)
    assert [row.response for row in rows(store)] == ["yes", "no", "yes"]
    kept = rows(store, PRACTICE_REPEATS)
    assert [(row.trial, row.repeat, row.response) for row in kept] == [
        (0, 0, "yes"), (1, 0, "yes"), (2, 0, "yes"),
    ]  # fmt: skip
    walk(store, token, "done")
    (session,) = rows(store, SESSIONS)
    assert (session.failed_checks, session.screened_out_at) == (None, None)


def test_after_the_last_repeat_the_session_has_ended(practice_store: Store) -> None:
    store = practice_store
    token = walk(store, enter(store, "Ada", scenario="drop"), PHASE)
    practise(store, token, "first", "no", "no", "no")
    state = practise(store, token, "second", "no", "no", "no")
    assert (state.stage, state.ended) == ("screened_out", True)
    assert store.ending(token).completion == Completion(code="out", url=None)
    assert run(store.enter(request("Ada", scenario="collide"))).state.stage == "screened_out"
    (session,) = rows(store, SESSIONS)
    assert session.screened_out_by == "practice"


@pytest.mark.parametrize("repeats", [0, 2])
def test_a_failed_practice_can_be_flagged(practising: Study, tmp_path: Path, repeats: int) -> None:
    study = replace(practising, practice=Practice(3, repeats, "flag"))
    store = open_store(study, Secrets.load(study.folder), tmp_path / "a")
    token = walk(store, enter(store, "Ada", scenario="drop"), PHASE)
    for number in range(repeats + 1):
        state = practise(store, token, f"repeat{number}", "yes", "yes", "yes")
    assert (state.stage, state.practice_repeats) == ("ready", repeats)
    walk(store, token, "done")
    (session,) = rows(store, SESSIONS)
    assert session.failed_checks == "practice" and session.finished_at is not None
    store.close()


def test_each_block_has_its_practice(practising: Study, tmp_path: Path) -> None:
    study = replace(practising, blocks=Blocks(all_scenarios=True))
    store = open_store(study, Secrets.load(study.folder), tmp_path / "a")
    token = enter(store, "Ada")
    for block, name in enumerate("ab"):
        walk(store, token, PHASE)
        practise(store, token, f"{name}-first", "no", "no", "no")
        state = run(store.state(token))
        first = state.blocks[block].familiarization[0]
        assert (state.stage, state.trial, state.practice_repeats) == (PHASE, first, 1)
        (session,) = rows(store, SESSIONS)
        order = trial_order(study, session.scenario, session.order_seed)[PHASE]
        right = ["yes" if order[first + step].label else "no" for step in range(3)]
        assert practise(store, token, f"{name}-second", *right).stage == "ready"
        walk(store, token, "block" if block == 0 else "done")
        if block == 0:
            page(store, token, "block")
    assert [(row.trial, row.repeat) for row in rows(store, PRACTICE_REPEATS)] == [
        (trial, 0) for trial in range(6)
    ]
    store.close()


def test_repeats_are_exported_and_forgotten(practising: Study, tmp_path: Path) -> None:
    study = replace(practising, practice=Practice(3, 1, "flag"))
    secrets, url = Secrets.load(study.folder), tmp_path / "a"
    store = open_store(study, secrets, url)
    token = walk(store, enter(store, "Ada", scenario="drop"), PHASE)
    practise(store, token, "first", "yes", "no", "no")
    practise(store, token, "second", "no", "no", "no")
    reference = run(store.state(walk(store, token, "done"))).reference
    out = export_study(store.engine, study, tmp_path / "out").out
    table = pd.read_csv(out / "practice_repeats.csv")
    assert table["response"].tolist() == ["yes", "no", "no"]
    assert table["correct"].tolist() == [True, True, False] and set(table["repeat"]) == {0}
    described = json.loads((out / "data_dictionary.json").read_text())["practice_repeats"]
    assert [column["name"] for column in described] == list(table.columns)
    sessions = pd.read_csv(out / "sessions.csv")
    assert sessions[["practice_repeats", "failed_checks"]].values.tolist() == [[1, "practice"]]
    answers = read_responses(out / "trials.csv", out / "sessions.csv").trials
    assert (answers["phase"] == PHASE).sum() == 3
    store.close()
    forget_sessions(url, [reference])
    store = open_store(study, secrets, url)
    assert rows(store, PRACTICE_REPEATS) == rows(store, ANSWERS) == rows(store, SHOWINGS) == []
    (session,) = rows(store, SESSIONS)
    assert (session.practice_repeats, session.failed_checks) == (0, None)
    store.close()
