"""Attention checks: counted, flagged and exported, and never part of the test's data."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pandas as pd
import pytest

from physion.analysis.people.exclusions import flag_sessions, read_expected
from physion.analysis.people.responses import read_responses
from physion.experiment.experimenter.progress import StudyProgress
from physion.experiment.export.export_study import export_study
from physion.experiment.store.database import SESSIONS
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.orders import trial_order
from physion.experiment.study.settings import Attention
from physion.experiment.study.stimuli import ATTENTION, Stimulus
from physion.experiment.study.study import Study
from support.experiment.store_walk import enter, give, open_store, rows, run, walk
from support.experiment.tiny_study import make_tiny_study


@pytest.fixture(scope="module")
def checked(tmp_path_factory: pytest.TempPathFactory) -> Study:
    return make_tiny_study(
        tmp_path_factory.mktemp("study"), test=4, familiarization=2, obvious=1, size=64,
        attention=Attention(instructed=2, max_failed=1),
    )  # fmt: skip


@pytest.fixture
def checked_store(checked: Study, database: Path) -> Iterator[Store]:
    opened = open_store(checked, Secrets.load(checked.folder), database)
    yield opened
    opened.close()


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
    # The accuracy is that of the test stimuli alone.
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
