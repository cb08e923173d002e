"""Pausing recruitment, void sessions, and deleting one session while the study is served."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

pytest.importorskip("fastapi", reason="the extra 'experiment' is not installed")

import sqlalchemy as sa

from physion.experiment.export.answer_tables import read_tables
from physion.experiment.protocol import Enter
from physion.experiment.store.database import ANSWERS, EVENTS, PAUSES, RAW_IDS, SESSIONS
from support.experiment.experimenter_client import Lab, Visitor, lab
from support.experiment.store_walk import enter, give, refusal, rows, run, walk


@pytest.fixture
def served(tmp_path: Path) -> Iterator[tuple[Lab, Visitor]]:
    with lab(tmp_path, participants=1, scenarios=("drop",), test=2, familiarization=1) as found:
        yield found, found.experimenter()


def session_of(found: Lab, reference: str) -> sa.Row:
    return next(row for row in rows(found.store, SESSIONS) if row.reference == reference)


def test_recruitment_is_paused_and_resumed(served: tuple[Lab, Visitor]) -> None:
    found, visitor = served
    browser = "a-browser-of-early"
    going = enter(found.store, "Early", visit=browser)
    assert visitor.submit("/recruitment", action="pause").status_code == 403  # no form token
    token = visitor.token("")
    assert "Pause recruitment" in visitor.see().text
    for _ in range(2):
        assert visitor.submit("/recruitment", token, action="pause").status_code == 303
    assert "Recruitment is paused" in visitor.see().text
    assert refusal(found.store.enter(Enter(id="Late"))).code == "paused"
    assert run(found.store.enter(Enter(id="Early", visit=browser))).state.stage == "consent"
    walk(found.store, going, "test")
    assert visitor.submit("/recruitment", token, action="resume").status_code == 303
    assert "Recruitment is paused" not in visitor.see().text
    (pause,) = rows(found.store, PAUSES)
    assert pause.paused_at < pause.resumed_at
    # Only the limit on participants refuses now.
    assert refusal(found.store.enter(Enter(id="Late"))).code == "study_full"
    assert visitor.submit("/recruitment", token, action="stop").status_code == 422
    anybody = found.visitor()
    assert anybody.submit("/recruitment", token, action="pause").headers["location"] == (
        "/experimenter/login"
    )


def test_a_void_session_does_not_count(served: tuple[Lab, Visitor]) -> None:
    found, visitor = served
    token = walk(found.store, enter(found.store, "Fake"), "done")
    row = session_of(found, run(found.store.state(token)).reference)
    assert refusal(found.store.enter(Enter(id="Next"))).code == "study_full"
    page = f"/sessions/{row.session}"
    form = visitor.token(page)
    assert visitor.submit(f"{page}/void", form, action="void").status_code == 303
    assert "This session is void" in visitor.see(page).text
    assert len(read_tables(found.store.engine, found.study)[1]) == 0
    later = enter(found.store, "Next")
    assert refusal(found.store.enter(Enter(id="Fake"))).code == "already_took_part"
    assert visitor.submit(f"{page}/void", form, action="count").status_code == 303
    assert len(read_tables(found.store.engine, found.study)[1]) == 1
    assert session_of(found, row.reference).voided_at is None
    # A void session that is not finished cannot be continued.
    other = session_of(found, run(found.store.state(later)).reference)
    visitor.submit(f"/sessions/{other.session}/void", form, action="void")
    assert run(found.store.state(later)).stage == "withdrawn"
    assert not found.store.ending(later).can_take_back
    assert refusal(found.store.enter(Enter(id="Next"))).code == "already_took_part"
    assert visitor.submit("/sessions/none/void", form, action="void").status_code == 404


def test_one_session_is_deleted_while_others_answer(served: tuple[Lab, Visitor]) -> None:
    found, visitor = served
    other, token = enter(found.store, "Other"), enter(found.store, "Gone")
    for each in (other, token):
        walk(found.store, each, "test")
    give(found.store, token, 0)
    row = session_of(found, run(found.store.state(token)).reference)
    page = f"/sessions/{row.session}"
    form = visitor.token(page)
    before = len(rows(found.store))
    assert visitor.submit(f"{page}/forget", form, word="yes").status_code == 422
    assert len(rows(found.store)) == before
    assert visitor.submit(f"{page}/forget", form, word=" Delete").status_code == 303
    assert not give(found.store, other, 0).duplicate
    for table in (ANSWERS, EVENTS):
        assert row.session not in {each.session for each in rows(found.store, table)}
    assert [each.raw_id for each in rows(found.store, RAW_IDS)] == ["Other"]
    gone = session_of(found, row.reference)
    assert (gone.device, gone.answered_test) == ({}, 0) and gone.closed_at is not None
    assert "No answer yet." in visitor.see(page).text
    if found.store.engine.dialect.name == "sqlite":
        content = b"".join(path.read_bytes() for path in found.study.folder.glob("*.sqlite*"))
        assert b"Gone" not in content and b"Other" in content
