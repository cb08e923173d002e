"""The database of a study: tables, lock and writer; backups, and deleting without a trace."""

from __future__ import annotations

import json
import os
import sqlite3
import threading
import traceback
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from sqlalchemy import Connection, Engine, event, insert, inspect, text
from sqlalchemy.exc import IntegrityError, SQLAlchemyError

from physion.cli.main import main
from physion.core.errors import BadInputError, PhysionError
from physion.experiment.protocol import Device, Enter, Event, Events
from physion.experiment.store.database import (
    ANSWERS,
    DATABASE_FILE,
    EVENTS,
    METADATA,
    RAW_IDS,
    SCHEMA,
    SESSIONS,
    TOKENS,
    Writer,
    create_database,
    open_database,
)
from physion.experiment.store.lab import back_up, forget, forget_raw_ids, forget_sessions
from physion.experiment.store.store import Refused, Store
from physion.experiment.study.identity import Secrets, participant_hash
from physion.experiment.study.study import Study
from support.experiment.store_walk import (
    begin,
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
    (tmp_path / DATABASE_FILE).touch()  # left by a server that was killed as it began
    create_database(tmp_path).dispose()
    with sqlite3.connect(tmp_path / DATABASE_FILE) as connection:
        assert connection.execute("PRAGMA user_version").fetchone() == (SCHEMA,)
    for engine in (create_database(tmp_path), open_database(tmp_path)):
        assert set(inspect(engine).get_table_names()) == set(METADATA.tables)
        engine.dispose()


def test_commits_wait_for_the_disk_and_only_the_owner_reads_the_files(
    engine: Engine, tmp_path: Path
) -> None:
    with engine.connect() as connection:
        found = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "synchronous", "foreign_keys", "secure_delete")
        }
        modes = {path.name: path.stat().st_mode & 0o777 for path in tmp_path.glob("*.sqlite*")}
    assert found == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "secure_delete": 1}
    names = (DATABASE_FILE, f"{DATABASE_FILE}-wal", f"{DATABASE_FILE}-shm")
    assert os.name != "posix" or modes == dict.fromkeys(names, 0o600)


def test_waiting_commands_share_a_commit_and_are_written_before_the_writer_closes(
    engine: Engine,
) -> None:
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
    writer.close()
    assert all(future.done() for future in futures) and kept(engine) == set(range(100))
    assert len(commits) == 2
    with pytest.raises(Refused, match="stopping"):
        writer.submit(put(999))


def test_other_files_and_tables_of_another_version_are_refused(
    engine: Engine, tmp_path: Path
) -> None:
    with engine.begin() as connection:
        connection.exec_driver_sql("PRAGMA user_version = 9")
    other = tmp_path / "other"
    other.mkdir()
    (other / DATABASE_FILE).write_bytes(b"no database at all" * 100)
    for ask in (create_database, open_database):
        with pytest.raises(BadInputError, match=f"version 9, this .* version {SCHEMA}") as caught:
            ask(tmp_path)
        assert "\n" not in str(caught.value)
        with pytest.raises(PhysionError, match="cannot be read: file is not a database"):
            ask(other)


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


# --- what a lab does: backups and deleting --------------------------------------------------------


@pytest.fixture
def served(tmp_path: Path) -> Study:
    return make_tiny_study(tmp_path / "study", test=2, familiarization=1, size=64)


def test_a_backup_of_a_served_study_is_a_study(
    served: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = Store.open(served, Secrets.load(served.folder))
    token = walk(store, enter(store, "Ada"), "test")
    give(store, token, 0)
    command = ["experiment", "backup", str(served.folder), "--media", "--secret", "--json"]
    assert main(command) == 0
    made = Path(json.loads(capsys.readouterr().out)["backup"])
    give(store, token, 1)  # not in the backup
    store.close()
    assert made.parent == served.folder / "backups"
    assert made.stat().st_mode & 0o077 == 0
    assert (made / "responses.sqlite").stat().st_mode & 0o077 == 0
    again = open_store(served, Secrets.load(made), made)
    found = [(row.phase, row.trial) for row in rows(again, ANSWERS)]
    assert found == [("familiarization", 0), ("test", 0)]
    again.close()
    for name in ("study.toml", "stimuli.csv", "secret.json", "texts/de.toml"):
        assert (made / name).read_bytes() == (served.folder / name).read_bytes()
    copied = {path.name for path in (made / "media").iterdir()}
    assert copied == {path.name for path in (served.folder / "media").iterdir()}
    # Keys and movies are left out unless wanted.
    made = back_up(served.folder, tmp_path / "safe")
    assert {path.name for path in made.iterdir()} == {
        "responses.sqlite", "study.toml", "stimuli.csv", "texts",
    }  # fmt: skip


def test_a_damaged_database_leaves_no_backup(served: Study, tmp_path: Path) -> None:
    store = Store.open(served, Secrets.load(served.folder))
    walk(store, enter(store, "Ada"), "done")
    store.close()
    path = served.folder / "responses.sqlite"
    content = bytearray(path.read_bytes())
    with sqlite3.connect(path) as connection:
        (root,) = connection.execute(
            "SELECT rootpage FROM sqlite_master WHERE name = 'answers'"
        ).fetchone()
        (size,) = connection.execute("PRAGMA page_size").fetchone()
    content[(root - 1) * size : root * size] = b"\x0d" + b"\xff" * (size - 1)
    path.write_bytes(content)
    with pytest.raises(PhysionError, match=r"damaged|could not be copied"):
        back_up(served.folder, tmp_path / "safe")
    assert list((tmp_path / "safe").iterdir()) == []


def test_what_is_no_study_or_was_never_served_is_named(served: Study, tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="not a study folder"):
        back_up(tmp_path, tmp_path / "safe")
    with pytest.raises(BadInputError, match="has the study been served"):
        back_up(served.folder, tmp_path / "safe")
    assert not (tmp_path / "safe").exists()


def raw_id(number: int) -> str:
    return f"5f1eada{number:04d}b0b" * 4


def fill(store: Store, count: int = 60) -> None:
    """Add people with ids and parameters, some of whom enter again, and other data."""
    for number in range(count):
        more = {"STUDY_ID": f"visit-first-{number:04d}"}
        token = begin(store, raw_id(number), source="prolific", recruiter=more, scenario="drop")
        if number % 5 == 0:
            page(store, token, "withdraw")
    for number in range(1, count, 3):
        if number % 5:
            more = {"STUDY_ID": f"visit-again-{number:04d}" * 5}
            enter(store, raw_id(number), source="prolific", recruiter=more)


def bytes_of(folder: Path) -> bytes:
    return b"".join(path.read_bytes() for path in sorted(folder.glob("*.sqlite*")))


@pytest.fixture
def filled(tmp_path: Path, small_study: Study, small_secrets: Secrets) -> Path:
    store = open_store(replace(small_study, participants=1000), small_secrets, tmp_path)
    fill(store)
    store.close()
    found = bytes_of(tmp_path)
    assert b"5f1eada" in found and b"visit-first" in found and b"visit-again" in found
    return tmp_path


def test_no_byte_of_the_ids_stays(filled: Path, small_study: Study, small_secrets: Secrets) -> None:
    assert forget(filled, None) == 60
    found = bytes_of(filled)
    assert b"5f1eada" not in found and b"visit-" not in found
    assert forget(filled, None) == 0
    store = open_store(small_study, small_secrets, filled)
    assert len(rows(store, SESSIONS)) == 60 and rows(store, RAW_IDS) == []
    # People are still recognised by their hash.
    entered = enter(store, raw_id(1), source="prolific", scenario="drop")
    assert len(rows(store, SESSIONS)) == 60
    assert run(store.state(entered)).stage == "instructions"
    store.close()


def test_single_participants_are_forgotten(filled: Path, small_secrets: Secrets) -> None:
    names = [participant_hash(small_secrets, "prolific", raw_id(number)) for number in (3, 4)]
    for wrong in ("0" * 32, "x", raw_id(3), "'; --", names[0].upper()):
        with pytest.raises(BadInputError, match="participant"):
            forget(filled, [names[0], wrong])
    assert raw_id(3).encode() in bytes_of(filled)
    assert forget(filled, [*names, names[0]]) == 2
    found = bytes_of(filled)
    assert raw_id(3).encode() not in found and b"-0004" not in found
    assert raw_id(5).encode() in found


def test_a_served_study_and_a_busy_reader_are_named(
    filled: Path, small_study: Study, small_secrets: Secrets, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = open_store(small_study, small_secrets, filled)
    with pytest.raises(PhysionError, match="another"):
        forget(filled, None)
    # While it is served, the store itself forgets ids.
    assert run(forget_raw_ids(store)) == 60
    assert not len(rows(store, RAW_IDS))
    store.close()
    monkeypatch.setattr("physion.experiment.store.database.BUSY_MS", 200)
    reader = sqlite3.connect(filled / "responses.sqlite", isolation_level=None)
    reader.execute("BEGIN")
    reader.execute("SELECT count(*) FROM raw_ids").fetchone()
    with pytest.raises(PhysionError, match="close that program and run"):
        forget(filled, None)
    reader.close()
    forget(filled, None)
    assert b"5f1eada" not in bytes_of(filled)


def test_the_verb_forgets_a_session_or_all_ids(
    filled: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def forget_by_verb(*words: str, study: Path = filled, code: int = 0) -> tuple[str, str]:
        assert main(["experiment", "forget", str(study), *words]) == code
        printed = capsys.readouterr()
        return printed.out, printed.err

    with sqlite3.connect(filled / "responses.sqlite") as connection:
        (reference,) = connection.execute("SELECT reference FROM sessions LIMIT 1").fetchone()
    assert forget_by_verb("--session", reference) == ("forgotten: 1 session\n", "")
    _, said = forget_by_verb("--session", "'; --", code=2)
    assert "no sessions have the reference" in said and said.count("\n") == 1
    forget_by_verb("--session", reference, "--all", code=2)
    for words in ((), ("--all", "--participant", "0" * 32)):
        assert "give the ids to delete" in forget_by_verb(*words, code=2)[1]
    assert json.loads(forget_by_verb("--all", "--json")[0]) == {"forgotten": 59}
    forget_by_verb("--all", study=tmp_path / "none", code=2)
    assert not (tmp_path / "none").exists()


def test_all_of_a_session_is_forgotten(
    tmp_path: Path, small_study: Study, small_secrets: Secrets
) -> None:
    store = open_store(small_study, small_secrets, tmp_path)
    seen = Device(user_agent="TellingBrowser")
    tokens = {
        scenario: begin(store, raw_id(1), source="sona", scenario=scenario, device=seen)
        for scenario in ("drop", "collide")
    }
    other = walk(store, enter(store, raw_id(2), source="sona", scenario="drop"), "demographics")
    for token in tokens.values():
        walk(store, token, "feedback")
        run(store.events(token, Events(events=[Event(kind="x", at_ms=1, data={"a": "TellingE"})])))
        page(store, token, "feedback", difficulty=2, technical_problems=False, text="TellingText")
    references = {one: run(store.state(token)).reference for one, token in tokens.items()}
    store.close()

    with pytest.raises(BadInputError, match="no sessions have the reference 'K7QF-29XM'"):
        forget_sessions(tmp_path, [references["drop"], "k7qf-29xm"])
    assert forget_sessions(tmp_path, [references["drop"].lower()]) == 1
    store = open_store(small_study, small_secrets, tmp_path)
    gone, kept = (
        next(row for row in rows(store, SESSIONS) if row.reference == references[scenario])
        for scenario in ("drop", "collide")
    )
    assert gone.withdrawn_at is not None and gone.consented_at is not None
    assert (gone.answered_test, gone.finished_at, gone.age, gone.gender) == (0, None, None, None)
    assert (gone.feedback, gone.device) == (None, {})
    assert kept.feedback == "TellingText" and kept.withdrawn_at is None and kept.answered_test == 4
    for table in (ANSWERS, EVENTS, TOKENS):
        sessions = {row.session for row in rows(store, table)}
        assert gone.session not in sessions and (table is EVENTS or len(sessions) == 2)
    assert len(rows(store, RAW_IDS)) == 2  # the other session still needs the id
    again = Enter(source="sona", id=raw_id(1), scenario="drop")
    assert refusal(store.enter(again)).code == "already_took_part"
    assert run(store.state(other)).stage == "demographics"
    store.close()

    assert forget_sessions(tmp_path, [references["collide"], references["drop"]]) == 2
    store = open_store(small_study, small_secrets, tmp_path)
    assert [row.raw_id for row in rows(store, RAW_IDS)] == [raw_id(2)]
    store.close()
    found = bytes_of(tmp_path)
    assert b"Telling" not in found and raw_id(1).encode() not in found
    assert raw_id(2).encode() in found
