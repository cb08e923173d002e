"""Declined and stopped sessions: how they end, and how they are taken up again; both databases."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from physion.experiment.protocol import Completion, Device, Enter, SessionEnd
from physion.experiment.store.database import EVENTS, RAW_IDS, SESSIONS
from physion.experiment.store.lab import forget_sessions
from physion.experiment.store.store import Refused, Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.study import EarlyEnd, Study
from support.experiment.store_walk import enter, give, page, refusal, request, rows, run, walk

DEVICE = Device(user_agent="Mozilla", screen_width=1920)
ENDS = {
    "declined": EarlyEnd("NOCONSENT", "no-consent", "https://lab.example/declined"),
    "stopped": EarlyEnd("STOPPED", "", "https://lab.example/stopped"),
    "full": EarlyEnd("FULL", "full", ""),
}


def come(store: Store, person: str, *, take_back: bool = False) -> Enter:
    return request(person, source="prolific", scenario="drop", device=DEVICE, take_back=take_back)


def test_a_declined_session_is_found_again_and_can_be_taken_back(store: Store) -> None:
    first = run(store.enter(come(store, "Ada")))
    assert page(store, first.token, "consent", agreed=False).stage == "declined"
    again = run(store.enter(come(store, "Ada")))
    assert again.state.stage == "declined"
    assert again.state.reference == first.state.reference
    assert store.ending(again.token).can_take_back
    # Opening the link once more stores nothing about somebody who declined.
    (session,) = rows(store, SESSIONS)
    assert (session.device, rows(store, RAW_IDS), rows(store, EVENTS)) == ({}, [], [])
    back = run(store.enter(come(store, "Ada", take_back=True)))
    assert (back.state.stage, back.state.reference) == ("consent", first.state.reference)
    (session,) = rows(store, SESSIONS)
    assert session.device == DEVICE.model_dump() and session.withdrawn_at is None
    assert [row.raw_id for row in rows(store, RAW_IDS)] == ["Ada"]
    walk(store, back.token, "done")


@pytest.mark.parametrize("stage", ["instructions", "familiarization"])
def test_stopping_before_the_first_answer_can_be_taken_back(store: Store, stage: str) -> None:
    token = walk(store, enter(store, "Ada", source="prolific", scenario="drop"), stage)
    assert page(store, token, "withdraw").stage == "withdrawn"
    assert store.ending(token).can_take_back
    back = run(store.enter(come(store, "Ada", take_back=True)))
    assert back.state.stage == stage


def test_stopping_after_an_answer_is_final(store: Store) -> None:
    token = walk(store, enter(store, "Ada", source="prolific", scenario="drop"), "familiarization")
    give(store, token, 0, "familiarization")
    page(store, token, "withdraw")
    assert not store.ending(token).can_take_back
    for take_back in (False, True):
        again = run(store.enter(come(store, "Ada", take_back=take_back)))
        assert again.state.stage == "withdrawn"
        assert again.state.reference == run(store.state(token)).reference


def test_going_on_has_no_ending(store: Store) -> None:
    token = enter(store, "Ada")
    with pytest.raises(Refused) as caught:
        store.ending(token)
    assert caught.value.code == "wrong_stage"


def test_another_scenario_comes_before_a_declined_one(store: Store) -> None:
    page(store, enter(store, "Ada", scenario="drop"), "consent", agreed=False)
    assert run(store.enter(request("Ada"))).state.scenario == "collide"


def test_deleted_data_cannot_be_taken_back(
    small_study: Study, small_secrets: Secrets, tmp_path: Path
) -> None:
    url = f"sqlite:///{tmp_path / 'a.sqlite'}"
    store = Store.open(small_study, small_secrets, url)
    token = walk(store, enter(store, "Ada", source="prolific", scenario="drop"), "instructions")
    page(store, token, "withdraw")
    reference = run(store.state(token)).reference
    store.close()
    forget_sessions(url, [reference])
    store = Store.open(small_study, small_secrets, url)
    try:
        refused = refusal(store.enter(come(store, "Ada", take_back=True)))
        assert refused.code == "already_took_part"
        (session,) = rows(store, SESSIONS)
        assert session.closed_at is not None and rows(store, RAW_IDS) == []
    finally:
        store.close()


@pytest.fixture
def telling(small_study: Study, small_secrets: Secrets, tmp_path: Path) -> Iterator[Store]:
    """A store of a study for one participant, with a code for each way to end."""
    study = replace(small_study, participants=1, **ENDS)
    store = Store.open(study, small_secrets, f"sqlite:///{tmp_path / 'a.sqlite'}")
    yield store
    store.close()


def test_each_way_to_end_has_its_own_code(telling: Store) -> None:
    site = "https://app.prolific.com/submissions/complete?cc="
    declined = enter(telling, "a", source="prolific", scenario="drop")
    page(telling, declined, "consent", agreed=False)
    stopped = walk(telling, enter(telling, "b", scenario="drop"), "familiarization")
    page(telling, stopped, "withdraw")
    assert telling.ending(declined) == SessionEnd(
        completion=Completion(code="NOCONSENT", url=site + "NOCONSENT"), can_take_back=True
    )
    assert telling.ending(stopped) == SessionEnd(
        completion=Completion(code=None, url="https://lab.example/stopped"), can_take_back=True
    )
    walk(telling, enter(telling, "c", scenario="drop"), "done")
    full = refusal(telling.enter(come(telling, "d")))
    assert (full.code, full.completion) == (
        "study_full", Completion(code="FULL", url=site + "FULL"),
    )  # fmt: skip
    # Nobody takes a place back that was given to another.
    assert refusal(telling.enter(come(telling, "a", take_back=True))).code == "study_full"
