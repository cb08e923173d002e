"""The database of a study: tables, versions, locks and durability; on both kinds."""

from __future__ import annotations

import os
import stat
import traceback
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.runtime.migration import MigrationContext
from sqlalchemy import insert, text
from sqlalchemy.exc import SQLAlchemyError

from physion.core.errors import BadInputError, PhysionError
from physion.experiment.store.database import (
    METADATA,
    RAW_IDS,
    check_version,
    connect_writer,
    open_database,
    server_lock,
    upgrade,
)


def test_upgrade_of_an_empty_database_gives_exactly_the_tables(database_url: str) -> None:
    engine = open_database(database_url)
    with pytest.raises(BadInputError, match="serve the study once"):
        check_version(engine)
    upgrade(engine)
    upgrade(engine)
    check_version(engine)
    with engine.connect() as connection:
        context = MigrationContext.configure(
            connection, opts={"compare_type": True, "compare_server_default": True}
        )
        assert compare_metadata(context, METADATA) == []
    engine.dispose()


def test_errors_tell_no_values(database_url: str) -> None:
    """Participants' ids must not reach a log through an error message."""
    engine = open_database(database_url)
    upgrade(engine)
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
    engine.dispose()


def test_tables_of_a_newer_version_are_refused(database_url: str) -> None:
    engine = open_database(database_url)
    upgrade(engine)
    with engine.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))
    for ask in (upgrade, check_version):
        with pytest.raises(BadInputError, match=r"newer version.*9999"):
            ask(engine)
    engine.dispose()


def test_a_second_server_is_refused_until_the_first_is_gone(database_url: str) -> None:
    engine, other = open_database(database_url), open_database(database_url)
    with server_lock(engine):
        writer = connect_writer(engine)
        with pytest.raises(PhysionError, match="another"), server_lock(other):
            connect_writer(other)
        writer.invalidate()
        writer.close()
    with server_lock(other):
        connect_writer(other).close()
    engine.dispose()
    other.dispose()


def test_commits_wait_for_the_disk(database_url: str) -> None:
    engine = open_database(database_url)
    with engine.connect() as connection:
        if engine.dialect.name == "sqlite":
            found = {
                name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
                for name in ("journal_mode", "synchronous", "foreign_keys", "secure_delete")
            }
            assert found == {
                "journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "secure_delete": 1,
            }  # fmt: skip
        else:
            assert connection.scalar(text("SHOW synchronous_commit")) == "on"
            assert connection.scalar(text("SHOW fsync")) == "on"
    engine.dispose()


@pytest.mark.skipif(os.name != "posix", reason="no such file modes on this system")
def test_only_the_owner_reads_the_file_and_its_log(tmp_path: Path) -> None:
    engine = open_database(f"sqlite:///{tmp_path / 'a.sqlite'}")
    upgrade(engine)
    with engine.connect() as connection:
        connection.execute(text("SELECT * FROM sessions"))
        modes = {path.name: stat.S_IMODE(path.stat().st_mode) for path in tmp_path.glob("a.sql*")}
    assert modes == dict.fromkeys(("a.sqlite", "a.sqlite-wal", "a.sqlite-shm"), 0o600)
    engine.dispose()


@pytest.mark.parametrize("url", ["mysql://a/b", "sqlite://", "sqlite:///:memory:", "no url", ""])
def test_other_addresses_are_refused(url: str) -> None:
    with pytest.raises(BadInputError, match="sqlite:///FILE or postgresql"):
        open_database(url)


def test_missing_files_and_servers_are_named(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="has the study been served"):
        open_database(f"sqlite:///{tmp_path / 'none.sqlite'}", must_exist=True)
    with pytest.raises(BadInputError, match="no folder"):
        open_database(f"sqlite:///{tmp_path / 'none' / 'a.sqlite'}")
    engine = open_database("postgresql://someone:hidden-word@127.0.0.1:1/none")
    with pytest.raises(PhysionError, match="does not answer") as caught:
        upgrade(engine)
    assert "hidden-word" not in str(caught.value)


def test_a_file_that_is_no_database_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.sqlite").write_bytes(b"no database at all" * 100)
    with pytest.raises(PhysionError, match="does not answer"):
        upgrade(open_database(f"sqlite:///{tmp_path / 'a.sqlite'}"))
