"""The writer: groups, refusals, faults and lost connections; acknowledged means committed."""

from __future__ import annotations

import asyncio
import contextlib
import sqlite3
import threading
import time
from collections.abc import Awaitable, Callable, Iterator
from concurrent.futures import Future
from pathlib import Path
from typing import Any, TypeVar

import pytest
from sqlalchemy import Connection, Engine, create_engine, event, text
from sqlalchemy.engine import make_url

from physion.experiment.protocol import Enter, PageDone
from physion.experiment.store.database import EVENTS, Writer, connect_writer, open_database
from physion.experiment.store.store import Refused, Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.recruitment import make_pass
from physion.experiment.study.study import Study
from support.experiment.postgres import Cluster
from support.experiment.store_walk import answer, enter, give, rows, run, walk

T = TypeVar("T")


@pytest.fixture
def engine(database_url: str) -> Iterator[Engine]:
    opened = open_database(database_url)
    with opened.begin() as connection:
        connection.execute(text("CREATE TABLE numbers (number INTEGER PRIMARY KEY)"))
    yield opened
    opened.dispose()


@contextlib.contextmanager
def writing(engine: Engine, **more: Any) -> Iterator[Writer]:
    writer = Writer(lambda: connect_writer(engine), **more)
    try:
        yield writer
    finally:
        writer.close()


def put(number: int) -> Callable[[Connection], int]:
    def command(connection: Connection) -> int:
        connection.execute(text("INSERT INTO numbers VALUES (:number)"), {"number": number})
        return number

    return command


def kept(engine: Engine) -> set[int]:
    with engine.connect() as connection:
        return set(connection.scalars(text("SELECT number FROM numbers")))


class Gate:
    """A command that blocks the writer until it is opened, so that a group gathers behind it."""

    def __init__(self) -> None:
        self.reached, self.open = threading.Event(), threading.Event()

    def __call__(self, connection: Connection) -> None:
        self.reached.set()
        assert self.open.wait(30)


def gather(writer: Writer, commands: list[Callable[[Connection], Any]]) -> list[Future[Any]]:
    """Queue all commands behind a gate, then open it."""
    gate = Gate()
    writer.submit(gate)
    assert gate.reached.wait(30)
    futures = [writer.submit(command) for command in commands]
    gate.open.set()
    for future in futures:
        future.exception(60)
    return futures


def test_waiting_commands_share_a_commit(engine: Engine) -> None:
    commits = []
    event.listen(engine, "commit", lambda connection: commits.append(1))
    with writing(engine, group=50) as writer:
        futures = gather(writer, [put(number) for number in range(100)])
        assert [future.result() for future in futures] == list(range(100))
    assert kept(engine) == set(range(100))
    # One for the gate, two for a hundred; PostgreSQL's lock takes one more.
    assert len(commits) <= 4


def test_nothing_is_acknowledged_before_the_commit(engine: Engine) -> None:
    committing, go_on = threading.Event(), threading.Event()

    @event.listens_for(engine, "commit")
    def hold(connection: Connection) -> None:
        committing.set()
        go_on.wait(30)

    go_on.set()
    with writing(engine) as writer:
        go_on.clear()
        committing.clear()
        future = writer.submit(put(1))
        assert committing.wait(30)
        time.sleep(0.1)
        assert not future.done() and kept(engine) == set()
        go_on.set()
        assert future.result(30) == 1
    assert kept(engine) == {1}


def test_refusals_and_faults_leave_the_others_alone(engine: Engine) -> None:
    def refuse(connection: Connection) -> None:
        raise Refused("not_yet", "no")

    def fault(connection: Connection) -> None:
        put(1000)(connection)
        raise ZeroDivisionError

    with writing(engine) as writer:
        futures = gather(writer, [put(1), refuse, put(2), fault, put(1), put(3)])
        errors = [type(future.exception()).__name__ for future in futures]
        assert errors == [
            "NoneType", "Refused", "NoneType", "ZeroDivisionError", "IntegrityError", "NoneType",
        ]  # fmt: skip
        assert writer.submit(put(4)).result(30) == 4
    assert kept(engine) == {1, 2, 3, 4}


def test_commands_beyond_the_queue_limit_are_refused(engine: Engine) -> None:
    gate = Gate()
    with writing(engine, waiting=5) as writer:
        writer.submit(gate)
        assert gate.reached.wait(30)
        futures = [writer.submit(put(number)) for number in range(5)]
        with pytest.raises(Refused, match="overloaded") as caught:
            writer.submit(put(99))
        assert caught.value.code == "unavailable"
        gate.open.set()
        assert [future.result(30) for future in futures] == [0, 1, 2, 3, 4]
    assert kept(engine) == {0, 1, 2, 3, 4}


def test_closing_runs_waiting_commands_and_refuses_new_ones(engine: Engine) -> None:
    writer = Writer(lambda: connect_writer(engine), group=2)
    gate = Gate()
    writer.submit(gate)
    futures = [writer.submit(put(number)) for number in range(7)]
    gate.open.set()
    writer.close()
    writer.close()
    assert [future.result(0) for future in futures] == list(range(7))
    with pytest.raises(Refused, match="stopping"):
        writer.submit(put(8))
    assert kept(engine) == set(range(7))


def test_cancelled_callers_do_not_stop_others(engine: Engine) -> None:
    async def ask(writer: Writer) -> int:
        gate = Gate()
        held = asyncio.ensure_future(writer.run(gate))
        gone = asyncio.ensure_future(writer.run(put(1)))
        stays = asyncio.ensure_future(writer.run(put(2)))
        await asyncio.sleep(0.05)
        gone.cancel()
        gate.open.set()
        await held
        return await stays

    with writing(engine) as writer:
        assert asyncio.run(ask(writer)) == 2
        # An event loop that ended while its command waited, and a cancelled future.
        gate = Gate()
        writer.submit(gate)
        given_up = writer.submit(put(3))
        assert given_up.cancel()
        gate.open.set()
        assert writer.submit(put(4)).result(30) == 4
    assert kept(engine) == {1, 2, 3, 4}


def test_the_writer_waits_for_a_locked_file(tmp_path: Path) -> None:
    path = tmp_path / "a.sqlite"
    engine = open_database(f"sqlite:///{path}")
    with engine.begin() as connection:
        connection.execute(text("CREATE TABLE numbers (number INTEGER PRIMARY KEY)"))
    event.listen(engine, "connect", lambda raw, _: raw.execute("PRAGMA busy_timeout=100"))
    engine.dispose()
    other = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
    with writing(engine, patience_s=30.0) as writer:
        other.execute("BEGIN IMMEDIATE")
        futures = [writer.submit(put(number)) for number in range(20)]
        time.sleep(0.6)
        assert not any(future.done() for future in futures)
        other.execute("COMMIT")
        assert [future.result(30) for future in futures] == list(range(20))
    with writing(engine, patience_s=0.3) as writer:
        other.execute("BEGIN IMMEDIATE")
        error = writer.submit(put(50)).exception(30)
        assert isinstance(error, Refused) and error.code == "unavailable"
        other.execute("COMMIT")
        assert writer.submit(put(51)).result(30) == 51
    other.close()
    assert kept(engine) == {*range(20), 51}
    engine.dispose()


def test_a_lost_connection_is_reopened(fresh_postgres: str) -> None:
    engine = open_database(fresh_postgres)
    with engine.begin() as connection:
        connection.execute(text("CREATE TABLE numbers (number INTEGER PRIMARY KEY)"))
    cut: list[int] = []

    def cut_off(connection: Connection) -> str:
        if not cut:
            cut.append(connection.scalar(text("SELECT pg_backend_pid()")) or 0)
            with engine.connect() as other:
                other.execute(text(f"SELECT pg_terminate_backend({cut[0]})"))
        return str(connection.scalar(text("SELECT 'there'")))

    with writing(engine) as writer:
        futures = gather(writer, [put(1), cut_off, put(2)])
        assert [future.result() for future in futures] == [1, "there", 2]
        # No other server may write: the new connection holds the lock again.
        with pytest.raises(Exception, match="another server"):
            connect_writer(engine)
    assert kept(engine) == {1, 2}
    engine.dispose()


def test_a_commit_without_confirmation_is_not_repeated(
    fresh_postgres: str, small_study: Study, small_secrets: Secrets
) -> None:
    store = Store.open(small_study, small_secrets, fresh_postgres)
    token = walk(store, enter(store, "Ada"), "test")
    lose: list[bool] = []

    @event.listens_for(store.engine, "commit")
    def commit_and_cut(connection: Connection) -> None:
        if lose:
            lose.clear()
            raw: Any = connection.connection.driver_connection
            pid = raw.info.backend_pid
            raw.commit()
            with store.engine.connect() as other:
                other.execute(text(f"SELECT pg_terminate_backend({pid})"))
            connection.execute(text("SELECT 'no answer'"))  # as if COMMIT itself failed

    lose.append(True)
    stored = give(store, token, 0)
    assert not lose and stored.duplicate  # recognised by its key
    lose.append(True)
    bob = enter(store, "Bob")
    assert not lose and run(store.state(bob)).stage == "consent"
    assert len([row for row in rows(store) if row.phase == "test"]) == 1
    assert [row.kind for row in rows(store, EVENTS)] == ["entered_again"]
    store.close()


@pytest.mark.slow
def test_restarts_of_postgresql_lose_nothing(
    postgres_cluster: Cluster, small_study: Study, small_secrets: Secrets
) -> None:
    admin = create_engine(
        make_url(postgres_cluster.url).set(drivername="postgresql+psycopg"),
        isolation_level="AUTOCOMMIT",
    )
    with admin.connect() as connection:
        connection.execute(text("CREATE DATABASE restarts"))
    admin.dispose()
    url = make_url(postgres_cluster.url).set(database="restarts")
    store = Store.open(small_study, small_secrets, url.render_as_string(hide_password=False))
    acknowledged: set[tuple[str, int]] = set()
    stop = threading.Event()

    async def until_there(ask: Callable[[], Awaitable[T]]) -> T:
        """Retry while the database is unavailable, as browsers do."""
        until = time.monotonic() + 300
        while True:
            try:
                return await ask()
            except Refused as refused:
                if refused.code != "unavailable" or time.monotonic() > until:
                    raise
            await asyncio.sleep(0.1)

    async def person(number: int) -> None:
        while not stop.is_set():
            name = f"{number}-{time.monotonic_ns()}"
            visit = Enter.model_validate({"id": name, "scenario": "drop", "pass": word})
            token = (await until_there(lambda visit=visit: store.enter(visit))).token

            async def send(token: str = token, **page: Any) -> None:
                await until_there(lambda: store.page(token, PageDone(**page)))

            await send(page="consent", data={"agreed": True})
            await send(page="instructions")
            for phase, count in (("familiarization", 3), ("test", 4)):
                for trial in range(count):
                    given = answer(trial, phase, key=f"{name}-{phase[0]}{trial}")
                    await until_there(lambda token=token, given=given: store.answer(token, given))
                    acknowledged.add((given.key, trial))
                    await asyncio.sleep(0.002)
                if phase == "familiarization":
                    await send(page="ready")

    async def everybody() -> None:
        people = [asyncio.ensure_future(person(number)) for number in range(8)]
        for mode in ("immediate", "fast", "immediate"):
            await asyncio.sleep(0.7)
            before = len(acknowledged)
            await asyncio.to_thread(postgres_cluster.stop, mode)
            await asyncio.to_thread(postgres_cluster.start)
            for _ in range(3000):
                await asyncio.sleep(0.1)
                if len(acknowledged) > before + 50:
                    break
            assert len(acknowledged) > before + 50
        stop.set()
        await asyncio.gather(*people)

    word = make_pass(small_secrets, "simulated")
    try:
        asyncio.run(everybody())
        stored = [(row.key, row.trial) for row in rows(store)]
    finally:
        store.close()
    assert len(stored) == len(set(stored))
    assert set(stored) == acknowledged
