"""Errors of writing name the file, whichever call failed."""

from __future__ import annotations

import errno
from pathlib import Path
from typing import Any

import pytest

from physion.cli import main as main_module
from physion.core import files as atomic
from physion.core.files import write_atomic


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
    assert capsys.readouterr().err == "physion: Could not find/load shared object file\n"
