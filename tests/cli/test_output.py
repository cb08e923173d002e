"""Progress where standard error is no terminal."""

from __future__ import annotations

import pytest

from physion.cli import output


@pytest.mark.parametrize(
    ("done", "seconds", "told"),
    [
        ((0, 5, 10, 15, 20), 20, ["trials: 10 of 50, 160 s left", "trials: 20 of 50, 120 s left"]),
        ((0, 1), 60, ["trials: 1 of 50"]),  # the first item says nothing of the rest
        ((0, 50), 5, []),
    ],
)
def test_long_work_is_reported_in_lines(
    done: tuple[int, ...],
    seconds: float,
    told: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    now = 100.0
    monkeypatch.setattr(output.time, "monotonic", lambda: now)
    with output.Stages() as stages:
        for count in done:
            stages("trials", count, 50)
            now += seconds
    assert capsys.readouterr().err.splitlines() == told
