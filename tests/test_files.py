"""Writing of files and their digests: together, atomic, never mixed up."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from physion.cli import main as main_module
from physion.core import files as atomic
from physion.core import files as digests
from physion.core.errors import BadInputError
from physion.core.files import (
    check_digest,
    digest_path,
    has_digest,
    is_whole,
    write_atomic,
    write_with_digest,
)
from physion.core.tables import read_csv


def test_a_file_has_its_digest_next_to_it(tmp_path: Path) -> None:
    path = tmp_path / "t.csv"
    assert not is_whole(path) and not has_digest(path)
    write_with_digest(path, b"a,b\n1,2\n")
    assert is_whole(path) and sorted(p.name for p in tmp_path.iterdir()) == [
        "t.csv", "t.csv.sha256",
    ]  # fmt: skip
    program = shutil.which("sha256sum")
    if program:
        done = subprocess.run([program, "--check", "t.csv.sha256"], cwd=tmp_path, check=False)
        assert done.returncode == 0


@pytest.mark.parametrize("damage", [b"", b"a,b\n", b"a,b\n1,3\n", b"a,b\n1,2\n\n", b"\xff"])
def test_any_other_content_is_noticed(tmp_path: Path, damage: bytes) -> None:
    path = tmp_path / "t.csv"
    write_with_digest(path, b"a,b\n1,2\n")
    path.write_bytes(damage)
    assert not is_whole(path)
    with pytest.raises(BadInputError, match=r"t\.csv was changed since it was written.*; do this"):
        check_digest(path, damage, "do this")
    with pytest.raises(BadInputError, match=r"delete t\.csv\.sha256 to use the table as it is"):
        read_csv(path, ["a"])
    digest_path(path).write_bytes(b"\xff\xfe")
    assert not is_whole(path)


def test_tables_of_others_need_no_digest(tmp_path: Path) -> None:
    (tmp_path / "t.csv").write_text("a,b\n1,2\n")
    assert read_csv(tmp_path / "t.csv", ["a"])["b"].tolist() == ["2"]


@pytest.mark.parametrize("step", range(3))
def test_a_fault_between_file_and_digest_leaves_no_wrong_digest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: int
) -> None:
    path = tmp_path / "t.csv"
    write_with_digest(path, b"old")
    replaced: list[str] = []
    replace = os.replace

    def failing(source: Path, target: Path) -> None:
        if len(replaced) == step:
            raise OSError(28, "No space left on device")
        replaced.append(str(target))
        replace(source, target)

    monkeypatch.setattr(atomic.os, "replace", failing)
    if step < 2:
        with pytest.raises(OSError, match="No space left"):
            write_with_digest(path, b"new")
    else:
        write_with_digest(path, b"new")
    content = path.read_bytes()
    assert content == (b"old" if step == 0 else b"new")
    check_digest(path, content, "")
    assert is_whole(path) == (step == 2)
    assert digests.has_digest(path) == (step == 2)


# Errors of writing name the file, whichever call failed.


@pytest.mark.parametrize("call", ["open", "write", "fsync", "replace"])
def test_a_full_disk_names_the_file(
    call: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    path = tmp_path / "table.csv"
    with monkeypatch.context() as changed:
        changed.setattr(atomic.os, call, full)
        with pytest.raises(OSError, match="No space left") as error:
            write_atomic(path, b"x")
    assert error.value.filename == str(path) and list(tmp_path.iterdir()) == []

    def failing(_: list[str]) -> int:
        raise error.value

    monkeypatch.setattr(main_module, "_run_verb", failing)
    assert main_module.main(["ls"]) == 2
    assert capsys.readouterr().err == f"physion: {path}: No space left on device\n"


def test_an_error_without_a_file_says_its_reason(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def failing(_: list[str]) -> int:
        raise OSError("Could not find/load shared object file")

    monkeypatch.setattr(main_module, "_run_verb", failing)
    assert main_module.main(["ls"]) == 2
    assert capsys.readouterr().err == ("physion: OSError: Could not find/load shared object file\n")
