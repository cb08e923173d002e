"""`physion doctor --bench` measures simulation, rendering and trials of a scenario."""

from __future__ import annotations

import json
import math

import pytest

from physion.cli.bench import COLUMNS
from physion.cli.main import main
from physion.core.version import MADE_WITH


@pytest.mark.nightly
@pytest.mark.slow
def test_every_quantity_of_a_scenario_is_measured(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "--bench", "--scenario", "drop", "--count", "1", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["package"] == MADE_WITH and found["count"] == 1
    (row,) = found["scenarios"]
    assert row.keys() == COLUMNS.keys() and row.pop("scenario") == "drop"
    assert row.pop("agreement") in (0.0, 1.0)
    assert all(math.isfinite(value) and value > 0 for value in row.values())
    # One trial was made: its frames over its two times are a whole number, at most 3 s of them.
    frames = row["frames_per_s"] * (row["choose_s"] + row["make_s"])
    assert frames == pytest.approx(round(frames), abs=1e-6) and 45 < frames <= 302


@pytest.mark.parametrize(
    ("options", "word"), [(["--count", "0"], "--count"), (["--scenario", "dorp"], "drop")]
)
def test_bad_options_are_one_line(
    options: list[str], word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["doctor", "--bench", *options]) == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and word in message
