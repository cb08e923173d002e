"""Backups: complete, consistent, readable by their owner only, also while a study is served."""

from __future__ import annotations

import json
import sqlite3
from pathlib import Path

import pytest

from physion.cli.main import main
from physion.core.errors import BadInputError, PhysionError
from physion.experiment.store.database import ANSWERS
from physion.experiment.store.lab import back_up
from physion.experiment.store.store import Store
from physion.experiment.study.identity import Secrets
from physion.experiment.study.study import Study
from support.experiment.store_walk import enter, give, open_store, rows, walk
from support.experiment.tiny_study import make_tiny_study


@pytest.fixture
def served(tmp_path: Path) -> Study:
    return make_tiny_study(tmp_path / "study", test=2, familiarization=1, size=64)


def test_a_backup_of_a_served_study_is_a_study(
    served: Study, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    store = Store.open(served, Secrets.load(served.folder))
    try:
        token = walk(store, enter(store, "Ada"), "test")
        give(store, token, 0)
        command = ["experiment", "backup", str(served.folder), "--media", "--secret", "--json"]
        assert main(command) == 0
        made = Path(json.loads(capsys.readouterr().out)["backup"])
        give(store, token, 1)  # not in the backup
    finally:
        store.close()
    assert made.parent == served.folder / "backups"
    assert made.stat().st_mode & 0o077 == 0
    assert (made / "responses.sqlite").stat().st_mode & 0o077 == 0
    again = open_store(served, Secrets.load(made), made)
    try:
        assert [(row.phase, row.trial) for row in rows(again, ANSWERS)] == [
            ("familiarization", 0), ("test", 0),
        ]  # fmt: skip
    finally:
        again.close()
    for name in ("study.toml", "stimuli.csv", "secret.json", "texts/de.toml"):
        assert (made / name).read_bytes() == (served.folder / name).read_bytes()
    kept = {path.name for path in (made / "media").iterdir()}
    assert kept == {path.name for path in (served.folder / "media").iterdir()}


def test_keys_and_movies_are_left_out_unless_wanted(served: Study, tmp_path: Path) -> None:
    Store.open(served, Secrets.load(served.folder)).close()
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
    with pytest.raises(BadInputError, match="no study folder"):
        back_up(tmp_path, tmp_path / "safe")
    with pytest.raises(BadInputError, match="has the study been served"):
        back_up(served.folder, tmp_path / "safe")
    assert not (tmp_path / "safe").exists()
