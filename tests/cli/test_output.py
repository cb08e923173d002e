"""Progress where standard error is no terminal."""

from __future__ import annotations

import pytest

from physion.cli import output


def test_long_work_is_told_in_lines_without_a_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = 100.0
    monkeypatch.setattr(output.time, "monotonic", lambda: now)
    with output.Stages() as stages:
        for done in range(0, 25, 5):
            stages("trials", done, 50)
            now += 20.0
    told = [line for line in capsys.readouterr().err.splitlines() if line]
    assert told == ["trials: 10 of 50, 160 s left", "trials: 20 of 50, 120 s left"]


def test_a_single_item_tells_nothing_of_the_rest(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now = 100.0
    monkeypatch.setattr(output.time, "monotonic", lambda: now)
    with output.Stages() as stages:
        for done in range(2):
            stages("trials", done, 50)
            now += 60.0
    assert capsys.readouterr().err == "trials: 1 of 50\n"


def test_short_work_prints_nothing_without_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with output.Stages() as stages:
        stages("trials", 1, 2)
        stages("trials", 2, 2)
    assert capsys.readouterr().err == ""
