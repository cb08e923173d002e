"""Consent first: nothing of a person is stored before it; and how sessions end early."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from physion.experiment.protocol import Completion, Device, Enter, Event, Events, SessionEnd
from physion.experiment.store.database import METADATA, RAW_IDS, SESSIONS, STUDIES
from physion.experiment.store.lab import set_paused
from physion.experiment.store.store import Refused, Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.settings import EarlyEnd
from physion.experiment.study.study import Study
from support.experiment.store_walk import (
    begin,
    enter,
    open_store,
    page,
    refusal,
    request,
    rows,
    run,
    walk,
)

DEVICE = Device(user_agent="TellingBrowser 7", screen_width=1917)
TELLING = (b"did-not-agree", b"TellingBrowser", b"1917", b"telling-visit", b"TellingEvent")
ENDS = {
    "declined": EarlyEnd("NOCONSENT", "no-consent", "https://lab.example/declined"),
    "stopped": EarlyEnd("STOPPED", "", "https://lab.example/stopped"),
    "full": EarlyEnd("FULL", "full", ""),
}


def come(person: str) -> Enter:
    return request(
        person, source="prolific", scenario="drop", device=DEVICE,
        recruiter={"STUDY_ID": "telling-visit"},
    )  # fmt: skip


def stored(store: Store, folder: Path) -> bytes:
    """Return all bytes of the database and its logs; assert that no table has a row of a person."""
    for table in METADATA.sorted_tables:
        assert table is STUDIES or rows(store, table) == [], table.name
    return b"".join(path.read_bytes() for path in folder.glob("*.sqlite*"))


@pytest.mark.parametrize("leaves", ["declining", "withdrawing", "closing the page"])
def test_nothing_of_a_person_is_stored_before_the_consent(
    store: Store, database: Path, leaves: str
) -> None:
    entered = run(store.enter(come("did-not-agree")))
    assert entered.state.stage == "consent"
    assert run(store.state(entered.token, load=True)).stage == "consent"
    telling = Events(events=[Event(kind="hidden", at_ms=1.0, data={"a": "TellingEvent"})])
    assert run(store.events(entered.token, telling)).stored == 0
    before = stored(store, database)
    if leaves == "declining":
        assert page(store, entered.token, "consent", agreed=False).stage == "declined"
    elif leaves == "withdrawing":
        assert page(store, entered.token, "withdraw").stage == "declined"
    after = stored(store, database)
    store.close()
    closed = b"".join(path.read_bytes() for path in database.glob("*.sqlite*"))
    assert len(before) > 4096
    for found in (before, after, closed):
        for word in (*TELLING, entered.state.reference.encode()):
            assert word not in found


def test_who_agrees_is_stored_with_id_browser_and_screen(store: Store, database: Path) -> None:
    entered = run(store.enter(come("Ada")))
    first = page(store, entered.token, "consent")
    assert (first.stage, first.reference) == ("instructions", entered.state.reference)
    # The same page, sent once more since its response was lost, begins nothing else.
    assert page(store, entered.token, "consent") == first
    (session,) = rows(store, SESSIONS)
    assert session.device == DEVICE.model_dump() and session.consented_at >= session.started_at
    assert [row.raw_id for row in rows(store, RAW_IDS)] == ["Ada"]
    walk(store, entered.token, "done")


def test_who_declined_may_open_the_link_again(store: Store) -> None:
    first = run(store.enter(come("Ada")))
    page(store, first.token, "consent", agreed=False)
    assert run(store.state(first.token)).stage == "declined"
    assert page(store, first.token, "withdraw").stage == "declined"
    assert refusal(store.page(first.token, _agreed())).code == "wrong_stage"
    walk(store, run(store.enter(come("Ada"))).token, "done")
    assert len(rows(store, SESSIONS)) == 1


def test_two_tabs_of_one_person_become_one_session(store: Store) -> None:
    tokens = [run(store.enter(come("Ada"))).token for _ in range(2)]
    references = {page(store, token, "consent").reference for token in tokens}
    assert len(references) == 1 and len(rows(store, SESSIONS)) == 1
    walk(store, tokens[1], "done")
    assert run(store.state(tokens[0])).stage == "done"


def test_visitors_are_distributed_like_sessions(store: Store) -> None:
    """A class that opens the link at once is not sent to one scenario."""
    tokens = [enter(store, f"person {number}") for number in range(6)]
    scenarios = [run(store.state(token)).scenario for token in tokens]
    assert sorted(scenarios) == ["collide"] * 3 + ["drop"] * 3
    for token, scenario in zip(tokens, scenarios, strict=True):
        assert page(store, token, "consent").scenario == scenario


def test_a_study_that_was_paused_meanwhile_takes_in_nobody(store: Store) -> None:
    token = enter(store, "Ada")
    run(store.write(lambda connection: set_paused(connection, True, 1.0)))
    assert refusal(store.page(token, _agreed())).code == "paused"
    run(store.write(lambda connection: set_paused(connection, False, 2.0)))
    assert page(store, token, "consent").stage == "instructions"


def test_the_memory_of_visitors_is_bounded(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("physion.experiment.store.store.MAX_VISITS", 3)
    tokens = [enter(store, f"person {number}") for number in range(4)]
    assert refusal(store.state(tokens[0])).code == "unknown_token"
    assert [run(store.state(token)).stage for token in tokens[1:]] == ["consent"] * 3


def _agreed() -> object:
    from physion.experiment.protocol import PageDone

    return PageDone(page="consent", data={"agreed": True})


@pytest.mark.parametrize("stage", ["instructions", "test"])
def test_stopping_is_final(store: Store, stage: str) -> None:
    token = walk(store, begin(store, "Ada", source="prolific", scenario="drop"), stage)
    assert page(store, token, "withdraw").stage == "withdrawn"
    again = run(store.enter(come("Ada")))
    assert again.state.stage == "withdrawn"
    assert again.state.reference == run(store.state(token)).reference


def test_going_on_has_no_ending(store: Store) -> None:
    for token in (enter(store, "Ada"), begin(store, "Bo")):
        with pytest.raises(Refused) as caught:
            store.ending(token)
        assert caught.value.code == "wrong_stage"


@pytest.fixture
def telling(small_study: Study, small_secrets: Secrets, tmp_path: Path) -> Iterator[Store]:
    """A store of a study for one participant, with a code for each way to end."""
    study = replace(small_study, participants=1, **ENDS)
    store = open_store(study, small_secrets, tmp_path / "a")
    yield store
    store.close()


def test_each_way_to_end_has_its_own_code(telling: Store) -> None:
    site = "https://app.prolific.com/submissions/complete?cc="
    declined = enter(telling, "a", source="prolific", scenario="drop")
    page(telling, declined, "consent", agreed=False)
    stopped = walk(telling, begin(telling, "b", scenario="drop"), "familiarization")
    page(telling, stopped, "withdraw")
    assert telling.ending(declined) == SessionEnd(
        completion=Completion(code="NOCONSENT", url=site + "NOCONSENT")
    )
    assert telling.ending(stopped) == SessionEnd(
        completion=Completion(code=None, url="https://lab.example/stopped")
    )
    late = enter(telling, "d", source="prolific", scenario="drop")
    walk(telling, begin(telling, "c", scenario="drop"), "done")
    for ask in (telling.enter(come("e")), telling.page(late, _agreed())):
        full = refusal(ask)
        assert (full.code, full.completion) == (
            "study_full", Completion(code="FULL", url=site + "FULL"),
        )  # fmt: skip


def test_a_place_is_held_only_once_the_practice_is_over(telling: Store) -> None:
    """Scripts that send the first pages only do not keep people away."""
    for number in range(20):
        walk(telling, begin(telling, f"script {number}", scenario="drop"), "familiarization")
    ada = walk(telling, begin(telling, "Ada", scenario="drop"), "test")
    held = refusal(telling.enter(come("Bo")))
    assert (held.code, held.completion) == ("held", None)
    assert "come back in 15 minutes" in str(held)
    walk(telling, ada, "done")
    assert refusal(telling.enter(come("Bo"))).code == "study_full"
