"""The database of a study: tables, version, lock and durability; and the writer."""

from __future__ import annotations

import os
import sqlite3
import stat
import threading
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from sqlalchemy import Connection, Engine, event, insert, inspect, text
from sqlalchemy.exc import IntegrityError, SQLAlchemyError

from physion.core.errors import BadInputError, PhysionError
from physion.experiment.store.database import (
    DATABASE_FILE,
    METADATA,
    RAW_IDS,
    SCHEMA,
    Writer,
    create_database,
    open_database,
    server_lock,
)
from physion.experiment.store.store import Refused


@pytest.fixture
def engine(tmp_path: Path) -> Iterator[Engine]:
    created = create_database(tmp_path)
    with created.begin() as connection:
        connection.execute(text("CREATE TABLE numbers (number INTEGER PRIMARY KEY)"))
    yield created
    created.dispose()


def put(number: int) -> Callable[[Connection], int]:
    def command(connection: Connection) -> int:
        connection.execute(text("INSERT INTO numbers VALUES (:number)"), {"number": number})
        return number

    return command


def kept(engine: Engine) -> set[int]:
    with engine.connect() as connection:
        return set(connection.scalars(text("SELECT number FROM numbers")))


def test_a_new_database_has_the_tables_and_keeps_them(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="has the study been served"):
        open_database(tmp_path)
    create_database(tmp_path).dispose()
    for engine in (create_database(tmp_path), open_database(tmp_path)):
        assert set(inspect(engine).get_table_names()) == set(METADATA.tables)
        engine.dispose()


def test_a_server_that_was_killed_as_it_began_leaves_a_database_that_can_be_made(
    tmp_path: Path,
) -> None:
    (tmp_path / DATABASE_FILE).touch()
    create_database(tmp_path).dispose()
    with sqlite3.connect(tmp_path / DATABASE_FILE) as connection:
        assert connection.execute("PRAGMA user_version").fetchone() == (SCHEMA,)


def test_tables_of_another_version_are_refused(engine: Engine, tmp_path: Path) -> None:
    with engine.begin() as connection:
        connection.exec_driver_sql("PRAGMA user_version = 9")
    for ask in (create_database, open_database):
        with pytest.raises(BadInputError, match=f"version 9, this .* version {SCHEMA}") as caught:
            ask(tmp_path)
        assert "\n" not in str(caught.value)


def test_a_file_that_is_no_database_is_refused(tmp_path: Path) -> None:
    (tmp_path / DATABASE_FILE).write_bytes(b"no database at all" * 100)
    for ask in (create_database, open_database):
        with pytest.raises(PhysionError, match="cannot be read: file is not a database"):
            ask(tmp_path)


def test_errors_tell_no_values(engine: Engine) -> None:
    """Participants' ids must not reach a log through an error message."""
    row = {"participant": "0" * 32, "source": "sona", "raw_id": "Ada-5f1e", "seen": 1.0}
    faults = (
        lambda connection: connection.execute(insert(RAW_IDS), row | {"recruiter": {}}),
        lambda connection: connection.execute(
            text("INSERT INTO raw_ids VALUES (:a, :b, :c, NULL, NULL)"),
            {"a": "1" * 32, "b": "sona", "c": "Ada-5f1e"},
        ),
        lambda connection: connection.execute(insert(RAW_IDS), [row | {"raw_id": object()}]),
    )
    with engine.begin() as connection:
        faults[0](connection)
    for fault in faults:
        with pytest.raises(SQLAlchemyError) as caught, engine.begin() as connection:
            fault(connection)
        said = "".join(traceback.format_exception(caught.value)) + repr(caught.value)
        assert "raw_ids" in said and "5f1e" not in said


def test_a_second_server_is_refused_until_the_first_is_gone(tmp_path: Path) -> None:
    stop = pytest.raises(PhysionError, match="stop the server")
    with server_lock(tmp_path), stop, server_lock(tmp_path):
        pass
    with server_lock(tmp_path):
        pass


def test_commits_wait_for_the_disk(engine: Engine) -> None:
    with engine.connect() as connection:
        found = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "synchronous", "foreign_keys", "secure_delete")
        }
    assert found == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "secure_delete": 1}


@pytest.mark.skipif(os.name != "posix", reason="no such file modes on this system")
def test_only_the_owner_reads_the_file_and_its_log(engine: Engine, tmp_path: Path) -> None:
    with engine.connect() as connection:
        connection.execute(text("SELECT * FROM sessions"))
        modes = {
            path.name: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.glob("*.sqlite*")
        }
    names = (DATABASE_FILE, f"{DATABASE_FILE}-wal", f"{DATABASE_FILE}-shm")
    assert modes == dict.fromkeys(names, 0o600)


def test_nothing_is_acknowledged_before_the_commit(engine: Engine) -> None:
    committing, go_on = threading.Event(), threading.Event()

    @event.listens_for(engine, "commit")
    def hold(connection: Connection) -> None:
        committing.set()
        assert go_on.wait(30)

    writer = Writer(engine)
    future = writer.submit(put(1))
    assert committing.wait(30)
    assert not future.done() and kept(engine) == set()
    go_on.set()
    assert future.result(30) == 1
    assert kept(engine) == {1}
    writer.close()


def test_refusals_and_faults_roll_back_only_their_own_command(engine: Engine) -> None:
    def refuse(connection: Connection) -> None:
        put(1000)(connection)
        raise Refused("not_yet", "no")

    writer = Writer(engine)
    futures = [writer.submit(command) for command in (put(1), refuse, put(1), put(2))]
    errors = [type(future.exception(30)) for future in futures]
    assert errors == [type(None), Refused, IntegrityError, type(None)]
    assert kept(engine) == {1, 2}
    writer.close()


def test_waiting_commands_share_a_commit(engine: Engine) -> None:
    commits, reached, go_on = [], threading.Event(), threading.Event()
    event.listen(engine, "commit", lambda connection: commits.append(1))

    def gate(connection: Connection) -> None:
        reached.set()
        assert go_on.wait(30)

    writer = Writer(engine)
    writer.submit(gate)
    assert reached.wait(30)
    futures = [writer.submit(put(number)) for number in range(100)]
    go_on.set()
    assert [future.result(30) for future in futures] == list(range(100))
    assert len(commits) == 2
    writer.close()


def test_waiting_commands_are_written_before_the_writer_closes(engine: Engine) -> None:
    writer = Writer(engine)
    futures = [writer.submit(put(number)) for number in range(50)]
    writer.close()
    assert all(future.done() for future in futures) and kept(engine) == set(range(50))
    with pytest.raises(Refused, match="stopping"):
        writer.submit(put(99))


def test_a_lock_of_another_program_is_a_refusal_after_which_all_continues(
    engine: Engine, tmp_path: Path
) -> None:
    writer = Writer(engine)
    other = sqlite3.connect(tmp_path / DATABASE_FILE, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    with engine.connect() as connection:  # so that the pool has a connection with the short wait
        connection.exec_driver_sql("PRAGMA busy_timeout = 50")
    with pytest.raises(Refused, match="cannot write") as caught:
        writer.submit(put(1)).result(30)
    assert caught.value.code == "unavailable"
    other.execute("ROLLBACK")
    assert writer.submit(put(2)).result(30) == 2
    other.close()
    writer.close()
    assert kept(engine) == {2}
