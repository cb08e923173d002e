"""Checks and questions of a session: attention, comprehension, practice, the lab's questions."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from sqlalchemy import inspect

from physion.analysis.people.exclusions import flag_sessions, read_expected
from physion.analysis.people.responses import read_responses
from physion.core.errors import BadInputError
from physion.experiment.experimenter.progress import StudyProgress
from physion.experiment.export.export_study import export_study
from physion.experiment.protocol import Completion, PageDone, SessionState
from physion.experiment.store.answering import ATTEMPT
from physion.experiment.store.database import ANSWERS, EVENTS, PRACTICE_REPEATS, SESSIONS, SHOWINGS
from physion.experiment.store.lab import forget_sessions
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.orders import trial_order
from physion.experiment.study.settings import Attention, Comprehension, EarlyEnd, Practice, Question
from physion.experiment.study.stimuli import ATTENTION, Stimulus
from physion.experiment.study.study import Study, load_study, write_settings
from physion.experiment.study.texts import shipped_file
from physion.experiment.web.api import public_study
from support.experiment.own_questions import (
    COMPREHENSION,
    COMPREHENSION_TEXTS,
    OWN_ANSWERS,
    OWN_QUESTIONS,
    OWN_TEXTS,
    RIGHT,
    WRONG,
)
from support.experiment.store_walk import (
    answer,
    enter,
    give,
    open_store,
    opened,
    page,
    refusal,
    request,
    rows,
    run,
    walk,
)
from support.experiment.tiny_study import make_tiny_study


@pytest.fixture(scope="module")
def checked(tmp_path_factory: pytest.TempPathFactory) -> Study:
    return make_tiny_study(
        tmp_path_factory.mktemp("study"), test=4, familiarization=2, obvious=1, size=64,
        attention=Attention(instructed=2, max_failed=1),
    )  # fmt: skip


@pytest.fixture
def checked_store(checked: Study, database: Path) -> Iterator[Store]:
    yield from opened(checked, database)


def order_of(store: Store, name: str) -> tuple[Stimulus, ...]:
    (seed,) = (row.order_seed for row in rows(store, SESSIONS) if row.reference == name)
    return trial_order(store.study, "collide", seed)["test"]


def take_test(store: Store, token: str, failed: int) -> None:
    """Answer the test right, besides the first so many attention checks."""
    walk(store, token, "test")
    for trial, stimulus in enumerate(order_of(store, run(store.state(token)).reference)):
        wrong = stimulus.phase == ATTENTION and failed > 0
        failed -= wrong
        give(store, token, trial, response="yes" if stimulus.label != wrong else "no")
    walk(store, token, "done")


def test_failed_checks_are_counted_and_flagged(checked_store: Store) -> None:
    store = checked_store
    for name, failed in (("Ada", 0), ("Bo", 1), ("Cy", 2)):
        take_test(store, enter(store, name), failed)
    sessions = sorted(rows(store, SESSIONS), key=lambda row: row.attention_failed)
    assert [(row.attention_failed, row.failed_checks) for row in sessions] == [
        (0, None), (1, None), (2, "attention"),
    ]  # fmt: skip
    # Only the test stimuli count for the accuracy.
    token = enter(store, "Di")
    take_test(store, token, 3)
    result = store.result(token)
    assert (result.correct, result.trials, result.accuracy) == (4, 4, 1.0)


def test_the_page_learns_only_of_instructed_checks(checked_store: Store) -> None:
    store = checked_store
    token = walk(store, enter(store, "Ada"), "instructions")
    order = order_of(store, run(store.state(token)).reference)
    media = store.trials(token, "test").trials
    for stimulus, sent in zip(order, media, strict=True):
        asked = stimulus.stimulus.startswith("instructed_")
        assert (sent.instructed is not None) == asked
        if asked:
            assert sent.instructed == ("yes" if stimulus.label else "no")
    assert sum(sent.instructed is not None for sent in media) == 2


def test_interrupted_checks_and_repeated_answers_do_not_count(checked_store: Store) -> None:
    store = checked_store
    token = walk(store, enter(store, "Ada"), "test")
    for trial, stimulus in enumerate(order_of(store, run(store.state(token)).reference)):
        wrong = "no" if stimulus.label else "yes"
        void = "dialog" if stimulus.phase == ATTENTION else None
        give(store, token, trial, response=wrong, void=void)
        assert give(store, token, trial, response=wrong, void=void).duplicate
    (session,) = rows(store, SESSIONS)
    assert (session.attention_failed, session.failed_checks) == (0, None)


def test_checks_are_no_trials_of_the_analysis(checked_store: Store, tmp_path: Path) -> None:
    store, study = checked_store, checked_store.study
    for name, failed in (("Ada", 0), ("Bo", 3)):
        take_test(store, enter(store, name), failed)
    out = export_study(store.engine, study, tmp_path / "out").out
    responses = read_responses(out / "trials.csv", out / "sessions.csv")
    assert len(responses.test) == 8 and responses.test["correct"].all()
    expected = read_expected(out / "expected.csv")
    flags = flag_sessions(responses, expected=expected).set_index("session")
    assert not flags["incomplete"].any() and flags["failed_checks"].sum() == 1
    table = pd.read_csv(out / "attention_checks.csv")
    assert len(table) == 6 and table["instructed"].sum() == 4
    assert (table["correct"] == (table["response"].eq("yes") == table["label"])).all()
    failed = table.groupby("session")["correct"].sum()
    assert sorted(failed) == [0, 3]
    sessions = pd.read_csv(out / "sessions.csv").set_index("session")
    assert sessions["attention_failed"].loc[failed.index].tolist() == (3 - failed).tolist()
    lines, _ = StudyProgress(study, store.engine).sessions("person")
    assert [(line.trials, line.accuracy) for line in lines] == [(4, 1.0)] * len(lines) != []


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
    yield from opened(checking, database)


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


def test_after_the_last_attempt_the_session_has_ended(
    checking_store: Store, tmp_path: Path
) -> None:
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
    out = export_study(store.engine, store.study, tmp_path / "out").out
    table = pd.read_csv(out / "sessions.csv").sort_values("comprehension_attempts")
    assert table["comprehension_attempts"].tolist() == [1, 2]
    assert table["screened_out"].fillna("").tolist() == ["", "comprehension"]
    assert (pd.read_csv(out / "events.csv")["kind"] == ATTEMPT).sum() == 3


def test_right_answers_are_not_sent(checking: Study) -> None:
    sent = public_study(checking, Secrets.load(checking.folder)).model_dump_json()
    assert '"comprehension_questions":[{"name":"task","options":["fall","touch"]}' in sent
    swapped = tuple(replace(each, right=each.options[0]) for each in COMPREHENSION)
    other = replace(checking, comprehension_questions=swapped)
    assert public_study(other, Secrets.load(checking.folder)).model_dump_json() == sent


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


@contextmanager
def practice_store(study: Study, folder: Path, rules: Practice) -> Iterator[Store]:
    """Open a store in which the practice has these rules."""
    store = open_store(
        replace(study, practice=rules), Secrets.load(study.folder), folder / "database"
    )
    yield store
    store.close()


def practise(store: Store, token: str, name: str, *responses: str) -> SessionState:
    """Answer the next practice trials; keys begin with ``name``."""
    state = run(store.state(token))
    for response in responses:
        assert state.trial is not None and state.stage == PHASE
        key = f"{name}-{state.trial:06d}"
        state = give(store, token, state.trial, PHASE, response=response, key=key).state
    return state


@pytest.mark.slow
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
    with practice_store(practising, tmp_path, Practice(needed, 1, "end")) as store:
        token = walk(store, enter(store, "Ada", scenario="drop"), PHASE)
        state = practise(store, token, "first", *responses)
        passed = right >= min(needed, 3)
        assert (state.stage, state.practice_repeats) == (("ready", 0) if passed else (PHASE, 1))
        assert len(rows(store, PRACTICE_REPEATS)) == (0 if passed else 3)


@pytest.mark.parametrize("failed", ["end", "flag"])
@pytest.mark.parametrize("repeats", [0, 1, 3])
def test_a_practice_is_repeated_as_often_as_the_study_says(
    practising: Study, tmp_path: Path, repeats: int, failed: str
) -> None:
    """Then it ends the session, or is passed and flagged."""
    with practice_store(practising, tmp_path, Practice(3, repeats, failed)) as store:
        token = walk(store, enter(store, "Ada", scenario="drop"), PHASE)
        for number in range(repeats):
            state = practise(store, token, f"repeat{number}", "no", "no", "no")
            assert (state.stage, state.practice_repeats, state.ended) == (PHASE, number + 1, False)
        state = practise(store, token, "the-last", "no", "no", "no")
        assert [(row.repeat, row.trial) for row in rows(store, PRACTICE_REPEATS)] == [
            (repeat, trial) for repeat in range(repeats) for trial in range(3)
        ]
        if failed == "end":
            assert (state.stage, state.ended) == ("screened_out", True)
            assert store.ending(token).completion == Completion(code="out", url=None)
            back = run(store.enter(request("Ada", scenario="collide")))
            assert back.state.stage == "screened_out"
        else:
            assert (state.stage, state.practice_repeats) == ("ready", repeats)
            walk(store, token, "done")
        (session,) = rows(store, SESSIONS)
        assert session.screened_out_by == ("practice" if failed == "end" else None)
        assert session.failed_checks == ("practice" if failed == "flag" else None)


def test_the_practice_is_repeated_and_then_passed(practising: Study, tmp_path: Path) -> None:
    with practice_store(practising, tmp_path, RULES) as store:
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
        assert [row.response for row in rows(store, PRACTICE_REPEATS)] == ["yes", "yes", "yes"]
        walk(store, token, "done")
        (session,) = rows(store, SESSIONS)
        assert (session.failed_checks, session.screened_out_at) == (None, None)


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


@pytest.fixture
def asking(tmp_path: Path) -> Study:
    return make_tiny_study(
        tmp_path / "study", test=2, familiarization=1, scenarios=("collide", "drop"), size=64,
        demographics=False, questions=OWN_QUESTIONS, more_texts=OWN_TEXTS,
    )  # fmt: skip


def test_own_questions_come_in_place_of_demographics(asking: Study, database: Path) -> None:
    store = open_store(asking, Secrets.load(asking.folder), database)
    token = walk(store, enter(store, "Ada", scenario="drop"), "questions")
    bad = PageDone(page="questions", data=OWN_ANSWERS | {"confidence": 9})
    assert "confidence" in str(refusal(store.page(token, bad)))
    assert run(store.state(token)).stage == "questions"
    assert page(store, token, "questions").stage == "feedback"
    again = {**OWN_ANSWERS, "games": "never"}
    assert page(store, token, "questions", **again).stage == "feedback"
    (session,) = rows(store, SESSIONS)
    assert session.own_answers == OWN_ANSWERS | {"devices": ["phone", "console"]}
    assert session.questions_at is not None and session.demographics_at is None
    assert page(store, token, "feedback").stage == "done"
    reference = run(store.state(token)).reference
    store.close()
    assert b"I looked" in (database / "responses.sqlite").read_bytes()
    forget_sessions(database, [reference])
    assert b"I looked" not in (database / "responses.sqlite").read_bytes()
    store = open_store(asking, Secrets.load(asking.folder), database)
    (session,) = rows(store, SESSIONS)
    assert (session.own_answers, session.questions_at) == (None, None)
    store.close()


def test_answers_are_exported_with_their_words(asking: Study, tmp_path: Path) -> None:
    store = open_store(asking, Secrets.load(asking.folder), tmp_path / "database")
    for scenario in ("collide", "drop"):
        walk(store, enter(store, "Ada", scenario=scenario), "done")
    walk(store, enter(store, "Bo", scenario="drop"), "questions")
    out = export_study(store.engine, store.study, tmp_path / "out").out
    store.close()
    table = pd.read_csv(out / "questions.csv")
    columns = ["strategy", "games", "devices_phone", "devices_console", "devices_computer",
               "confidence"]  # fmt: skip
    assert list(table.columns) == ["participant", "session", *columns] and len(table) == 2
    first = table.iloc[0]
    assert first["strategy"] == f"'{OWN_ANSWERS['strategy']}", "no formula for a spreadsheet"
    assert [first[name] for name in columns[1:]] == ["often", True, True, False, 4]
    assert set(table["session"]) <= set(pd.read_csv(out / "sessions.csv")["session"])
    described = json.loads((out / "data_dictionary.json").read_text())["questions"]
    assert [column["name"] for column in described] == list(table.columns)
    (scale,) = (column for column in described if column["name"] == "confidence")
    assert scale["about"] == "How sure were you? (1: Not at all, 5: Very)" and scale["high"] == 5
    psych = json.loads((out / "psych-ds" / "dataset_description.json").read_text())
    assert set(columns) <= {each["name"] for each in psych["variableMeasured"]}
    assert len(list((out / "psych-ds" / "data").glob("*questions_data.csv"))) == 1


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
