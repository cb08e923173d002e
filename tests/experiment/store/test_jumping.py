"""Previews go to any page and trial; sessions of people do not."""

from __future__ import annotations

from typing import Any

import pytest

from physion.experiment.protocol import Jump
from physion.experiment.store.database import SESSIONS
from physion.experiment.store.sessions import stages_of
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.study import Study
from support.experiment.store_walk import (
    ORDER,
    STAGES,
    enter,
    give,
    page,
    refusal,
    rows,
    run,
    walk,
)


def preview(store: Store, secrets: Secrets) -> str:
    link: dict[str, Any] = {"pass": make_pass(secrets, "preview"), "scenario": "drop"}
    return enter(store, "Me", **link)


@pytest.mark.parametrize("start", ["consent", "test", "done"])
@pytest.mark.parametrize("stage", STAGES)
def test_a_preview_goes_to_every_page(
    sqlite_store: Store, small_secrets: Secrets, start: str, stage: str
) -> None:
    store = sqlite_store
    token = walk(store, preview(store, small_secrets), start)
    to = Jump.model_validate({"stage": stage, "trial": 1})
    trial = 1 if stage in ("familiarization", "test") else None
    for _ in range(2):
        state = run(store.jump(token, to))
        assert (state.stage, state.trial) == (stage, trial)
    assert run(store.state(token)) == state
    walk(store, token, "done")
    assert store.result(token).trials == 4


def test_previews_learn_the_places_and_people_do_not(
    sqlite_store: Store, small_study: Study, small_secrets: Secrets
) -> None:
    token = preview(sqlite_store, small_secrets)
    places = run(sqlite_store.state(token)).places
    assert places == list(stages_of(small_study)) and places[-1] == "done"
    for texts in small_study.texts.values():
        assert all(f"preview.{stage}" in texts for stage in ORDER)
    assert run(sqlite_store.state(enter(sqlite_store, "Ada"))).places == []


def test_a_trial_can_be_answered_again(store: Store, small_secrets: Secrets) -> None:
    token = walk(store, preview(store, small_secrets), "test")
    give(store, token, 0, response="yes")
    give(store, token, 1)
    run(store.jump(token, Jump(stage="test", trial=0)))
    assert not give(store, token, 0, response="no", key="another-key").duplicate
    test = [(row.trial, row.response) for row in rows(store) if row.phase == "test"]
    assert test == [(0, "no")]
    page(store, token, "withdraw")
    assert run(store.jump(token, Jump(stage="feedback"))).stage == "feedback"


def test_people_and_absent_trials_are_refused(store: Store, small_secrets: Secrets) -> None:
    person = walk(store, enter(store, "Ada", scenario="drop"), "test")
    before = rows(store, SESSIONS)
    assert refusal(store.jump(person, Jump(stage="done"))).code == "bad_request"
    assert rows(store, SESSIONS) == before
    token = preview(store, small_secrets)
    assert "the last one is 3" in str(refusal(store.jump(token, Jump(stage="test", trial=4))))
    for stage in ("declined", "questions"):
        to = Jump.model_validate({"stage": stage})
        assert f"no {stage}" in str(refusal(store.jump(token, to)))
    simulated = enter(store, "Sim", **{"pass": make_pass(small_secrets, "simulated")})
    assert refusal(store.jump(simulated, Jump(stage="done"))).code == "bad_request"
