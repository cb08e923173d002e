"""Storing answers: exactly once and in order, for any requests and when the server is killed."""

from __future__ import annotations

import asyncio
import json
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sqlalchemy as sa
from hypothesis import given, settings
from hypothesis import strategies as st
from sqlalchemy import delete

from physion.experiment.protocol import Answer, PageDone
from physion.experiment.simulated import SimulatedVisit, SimulationPlan, simulate
from physion.experiment.store.database import ANSWERS, METADATA, SESSIONS, STUDIES, open_database
from physion.experiment.store.store import Refused, Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.media import read_media_path
from physion.experiment.study.orders import trial_order
from physion.experiment.study.study import Study
from support.experiment.serving import QuickServer, stored_answers, stored_sessions
from support.experiment.store_walk import (
    answer,
    enter,
    give,
    open_store,
    page,
    refusal,
    rows,
    run,
    walk,
)
from support.experiment.tiny_study import make_tiny_study


def test_an_answer_is_stored_as_it_was_sent(store: Store, small_study: Study) -> None:
    token = walk(store, enter(store, "Ada", scenario="drop"), "test")
    sent = answer(
        0, response="no", rt_ms=1234.5678901, input="keyboard", fixation_ms=700.25, cue_ms=2000.5,
        frames_shown=44, frames_dropped=1, movie_ms=1466.7, visibility_changes=2,
        window_width=1024, window_height=600, break_ms=61_500.5,
        details={"frames": [1, 2.5, None], "'; DROP TABLE\0 é": "☃ 🎲"},
    )  # fmt: skip
    stored = run(store.answer(token, sent))
    assert not stored.duplicate and stored.feedback is None and stored.state.trial == 1
    (session,) = rows(store, SESSIONS)
    row = next(row for row in rows(store) if row.phase == "test")
    for name in ("key", "response", "rt_ms", "input", "fixation_ms", "cue_ms", "frames_shown",
                 "frames_dropped", "movie_ms", "visibility_changes", "window_width",
                 "break_ms"):  # fmt: skip
        assert getattr(row, name) == getattr(sent, name)
    assert json.loads(row.details) == sent.details
    assert row.stimulus == trial_order(small_study, "drop", session.order_seed)["test"][0].stimulus
    assert row.frames_expected == 45 and not row.resumed
    assert session.answered_test == 1 and session.last_seen == row.answered_at


def test_only_familiarization_gives_feedback(store: Store, small_study: Study) -> None:
    token = walk(store, enter(store, "Ada", scenario="drop"), "familiarization")
    for trial, stimulus in enumerate(small_study.phase("drop", "familiarization")):
        response = "yes" if trial != 1 else "no"
        stored = give(store, token, trial, "familiarization", response=response)
        assert stored.feedback is not None
        assert stored.feedback.contact == stimulus.label
        assert stored.feedback.correct == ((response == "yes") == stimulus.label)
        assert stored.feedback.frames == 60
        found = read_media_path(store.study, store.secrets, stored.feedback.movie)
        assert found == store.study.folder / stimulus.full
        # The same key with another response: the stored response counts.
        again = give(store, token, trial, "familiarization", response="no")
        assert again.duplicate and again.feedback == stored.feedback
    page(store, token, "ready")
    replies = [give(store, token, trial) for trial in range(4)]
    assert all(each.feedback is None for each in replies)
    for reply in replies:
        words = reply.model_dump_json().lower()
        assert not any(word in words for word in ("label", "correct", 'contact":', "tiny"))


def test_answers_out_of_order_are_refused_with_the_state(store: Store) -> None:
    token = enter(store, "Ada")
    cases = [
        ("consent", answer(0, "familiarization"), "wrong_stage"),
        ("familiarization", answer(1, "familiarization"), "out_of_order"),
        ("familiarization", answer(0, "test"), "out_of_order"),
        ("ready", answer(2, "familiarization", key="another-key"), "already_answered"),
        ("ready", answer(0, "test"), "wrong_stage"),
        ("test", answer(0, "test", key="familiarization-0000"), "already_answered"),
        ("test", answer(1, "test"), "out_of_order"),
        ("test", answer(3, "familiarization"), "out_of_order"),
        ("demographics", answer(4, "test"), "wrong_stage"),
        ("demographics", answer(100_000, "test"), "wrong_stage"),
        ("done", answer(0, "test", key="another-key"), "already_answered"),
    ]
    for stage, sent, code in cases:
        walk(store, token, stage)
        before = rows(store), rows(store, SESSIONS)
        refused = refusal(store.answer(token, sent))
        assert refused.code == code, (stage, sent)
        assert refused.state == run(store.state(token))
        assert (rows(store), rows(store, SESSIONS)) == before
    # The refused requests do not block the right one; the same key in another session is another.
    give(store, token, 0, "familiarization")
    other = walk(store, enter(store, "Bob"), "familiarization")
    assert not give(store, other, 0, "familiarization").duplicate


@pytest.mark.slow
def test_details_are_bounded_plain_json(store: Store) -> None:
    token = walk(store, enter(store), "familiarization")
    deep: Any = []
    for _ in range(100_000):
        deep = [deep]
    bad = [{"a": "x" * 17_000}, {"a": float("nan")}, {"a": float("inf")}, {"a": 10**5000},
           {"a": {1, 2}}, {"a": deep}]  # fmt: skip
    for details in bad:
        sent = Answer.model_construct(**{**dict(answer(0, "familiarization")), "details": details})
        refused = refusal(store.answer(token, sent))
        assert refused.code == "bad_request" and refused.message.startswith("details")
    assert rows(store) == []
    give(store, token, 0, "familiarization", details={"a": "\ud800", "b": "x" * 16_000})


def test_racing_tabs_make_one_row(store: Store) -> None:
    one = walk(store, enter(store, "Ada"), "test")
    two = enter(store, "Ada")

    async def race() -> list[Any]:
        sent = [(token, answer(0, key=f"key-of-tab-{tab}")) for tab, token in enumerate((one, two))]
        posts = [store.answer(token, each) for token, each in sent * 20]
        return await asyncio.gather(*posts, return_exceptions=True)

    replies = run(race())
    (row,) = [row for row in rows(store) if row.phase == "test"]
    winner = int(row.key[-1])
    accepted = [each for each in replies if not isinstance(each, BaseException)]
    refused = [each for each in replies if isinstance(each, Refused)]
    assert len(accepted) == len(refused) == 20
    assert sum(not each.duplicate for each in accepted) == 1
    assert all(each.code == "already_answered" for each in refused)
    assert not isinstance(replies[winner], BaseException)
    assert run(store.state(two)).trial == 1


@pytest.fixture(scope="module")
def machine(
    small_study: Study, small_secrets: Secrets, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Store]:
    """One store for all examples; a database for each would take minutes."""
    store = open_store(small_study, small_secrets, tmp_path_factory.mktemp("machine"))
    yield store
    store.close()


def new_session(store: Store) -> str:
    """Empty the tables and begin a session."""
    with store.engine.begin() as connection:
        for table in reversed(METADATA.sorted_tables):
            if table is not STUDIES:
                connection.execute(delete(table))
    return walk(store, enter(store), "familiarization")


POSTS = st.lists(
    st.one_of(
        st.tuples(st.just("answer"), st.sampled_from(["familiarization", "test"]),
                  st.integers(0, 5), st.integers(0, 2)),
        st.tuples(st.just("next"), st.integers(0, 2), st.integers(1, 3)),
        st.tuples(st.just("ready")),
        st.tuples(st.just("load")),
    ),
    max_size=40,
)  # fmt: skip


@pytest.mark.slow
@settings(max_examples=60, deadline=None)
@given(POSTS)
def test_any_sequence_of_requests_stores_the_first_trials_once(machine: Store, posts: Any) -> None:
    store, token = machine, new_session(machine)
    model: dict[str, list[str]] = {"familiarization": [], "test": []}

    async def send() -> None:
        for kind, *rest in posts:
            if kind == "ready":
                if len(model["familiarization"]) < 3:
                    with pytest.raises(Refused, match="is not next"):
                        await store.page(token, PageDone(page="ready"))
                else:
                    await store.page(token, PageDone(page="ready"))
            elif kind == "load":
                await store.state(token, True)
            else:
                await post(kind, rest)

    async def post(kind: str, rest: Any) -> None:
        state = await store.state(token)
        if kind == "answer":
            phase, trial, variant = rest
            times = 1
        elif state.trial is None:
            return
        else:
            phase, trial, (variant, times) = state.stage, state.trial, rest
        key = f"{phase}-{trial}-{variant}"
        replies = await asyncio.gather(
            *(store.answer(token, answer(trial, phase, key=key)) for _ in range(times)),
            return_exceptions=True,
        )
        known = model[phase]
        for reply in replies:
            if isinstance(reply, Refused):
                assert reply.code in ("wrong_stage", "out_of_order", "already_answered")
                assert trial >= len(known) or known[trial] != key
            else:
                assert not isinstance(reply, BaseException)
                assert reply.duplicate == (trial < len(known))
                if not reply.duplicate:
                    assert trial == len(known)
                    known.append(key)
                assert known[trial] == key

    run(send())
    stored: dict[str, list[str]] = {"familiarization": [], "test": []}
    for row in sorted(rows(store), key=lambda row: (row.phase, row.trial)):
        assert row.trial == len(stored[row.phase])
        stored[row.phase].append(row.key)
    assert stored == model
    (session,) = rows(store, SESSIONS)
    assert [session.answered_familiarization, session.answered_test] == [
        len(model["familiarization"]),
        len(model["test"]),
    ]
    assert len({row.stimulus for row in rows(store)}) == len(rows(store, ANSWERS))


# --- a server that is killed under load -----------------------------------------------------------


PHASES = {"familiarization": 3, "test": 12}
LONGEST_RUN_S = 0.4
"""Longest time in seconds between the start of the server and a kill."""


class Load:
    """Waves of participants until the context ends, which waits for the last ones to finish."""

    def __init__(self, study: Study, url: str, people: int) -> None:
        self._study, self._secrets = study, Secrets.load(study.folder)
        self._url, self._people = url, people
        self._stopping = threading.Event()
        self.waves: list[list[SimulatedVisit]] = []
        self._thread = threading.Thread(target=lambda: asyncio.run(self._run()), daemon=True)
        self.error: BaseException | None = None

    async def _run(self) -> None:
        try:
            await asyncio.gather(*(self._run_waves(number) for number in range(3)))
        except BaseException as error:
            self.error = error

    async def _run_waves(self, number: int) -> None:
        wave = 0
        while not self._stopping.is_set():
            plan = SimulationPlan(
                self._url, self._people, seed=1000 * number + wave, dropouts=0.0,
                waits_s=(0.05, 0.4), patience_s=300.0,
            )  # fmt: skip
            self.waves.append(await simulate(self._study, self._secrets, plan))
            wave += 1

    def __enter__(self) -> Load:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._stopping.set()
        if kind is not None:  # the server may have ended
            return
        self._thread.join(300)
        assert not self._thread.is_alive(), "the participants did not get to the end"
        if self.error is not None:
            raise self.error

    @property
    def visits(self) -> list[SimulatedVisit]:
        """The visits of all waves."""
        return [visit for wave in self.waves for visit in wave]


def kill_again_and_again(server: QuickServer, kills: int, seed: int) -> None:
    """Kill the server at random moments, mostly while it serves and sometimes while it starts."""
    rng = np.random.default_rng(seed)
    for number in range(kills):
        time.sleep(rng.random() * LONGEST_RUN_S)
        server.kill()
        if number % 10 == 5:
            server.launch()
            time.sleep(rng.random() * LONGEST_RUN_S)
            server.kill()
        server.start()


def check(study: Study, visits: list[SimulatedVisit]) -> None:
    """Check that all acknowledged answers are stored unaltered and all sessions are complete."""
    assert {visit.outcome for visit in visits} == {"done"}, [
        visit for visit in visits if visit.outcome != "done"
    ][:3]
    stored, sessions = stored_answers(study), stored_sessions(study)
    known = {(visit.reference, a.phase, a.trial): a for visit in visits for a in visit.answers}
    assert len(known) == sum(len(visit.answers) for visit in visits), "acknowledged twice"
    for trial, acknowledged in known.items():
        row = stored[trial]
        sent = (acknowledged.key, acknowledged.stimulus, acknowledged.response, acknowledged.rt_ms)
        assert (row.key, row.stimulus, row.response, row.rt_ms) == sent
    assert len(sessions) == len(visits)
    assert len(stored) == len(visits) * sum(PHASES.values())
    for session in sessions.values():
        assert session.finished_at is not None and session.kind == "simulated"
        assert session.answered_familiarization == PHASES["familiarization"]
        assert session.answered_test == PHASES["test"]


@pytest.mark.slow
@pytest.mark.parametrize("kills", [10, pytest.param(50, marks=pytest.mark.nightly)])
def test_nothing_is_lost_when_the_server_is_killed_again_and_again(
    kills: int, tmp_path: Path
) -> None:
    study = make_tiny_study(tmp_path / "study", **PHASES)
    with QuickServer(study.folder) as server, Load(study, server.url, people=5) as load:
        kill_again_and_again(server, kills, seed=1)
    assert sum(visit.retries for visit in load.visits) > kills, "the kills met no load"
    check(study, load.visits)
    engine = open_database(study.folder)
    with engine.connect() as connection:
        assert connection.scalar(sa.text("PRAGMA integrity_check")) == "ok"
    engine.dispose()
