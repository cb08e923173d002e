"""Tests are skipped for what is absent on a developer's machine, and fail for it in `.ci/run`."""

from __future__ import annotations

from pathlib import Path

import pytest

from support.programs import find_chromium, find_program

ROOT = Path(__file__).parents[1]


def test_what_is_absent_skips_or_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PHYSION_BROWSER", "no-such-program")
    monkeypatch.delenv("PHYSION_SKIP_NOTHING", raising=False)
    with pytest.raises(pytest.skip.Exception, match=r"Chromium is absent.*PHYSION_BROWSER"):
        find_chromium()
    monkeypatch.setenv("PHYSION_SKIP_NOTHING", "1")
    with pytest.raises(pytest.fail.Exception, match="Chromium is absent"):
        find_chromium()
    with pytest.raises(pytest.fail.Exception, match="no-such-program is absent: install it;"):
        find_program("no-such-program")


def test_a_named_program_goes_first(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    monkeypatch.setenv("ONE", str(program))
    assert find_program("sh", variable="ONE") == str(program)
    monkeypatch.delenv("ONE")
    assert find_program("no-such-program", "sh", variable="ONE").endswith("/sh")


def test_nothing_is_skipped_before_a_change_lands() -> None:
    lines = (ROOT / ".ci" / "run").read_text().splitlines()
    exported = [line for line in lines if line.startswith("export ")]
    assert any("PHYSION_SKIP_NOTHING=1" in line for line in exported)
