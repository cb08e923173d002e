"""Files of responses: errors name the place, warnings count what would be left out."""

from __future__ import annotations

import json
from pathlib import Path

import pandas as pd
import pytest

from physion.analysis.check import check_responses
from physion.cli.main import main
from support.simulated_people import simulate_study


@pytest.fixture
def file(tmp_path: Path) -> Path:
    trials, _ = simulate_study(people=6, stimuli=12, scenarios=("drop",), seed=3)
    path = tmp_path / "trials.csv"
    trials.to_csv(path, index=False)
    return path


def test_a_good_file_has_no_error_and_its_people_are_counted(file: Path) -> None:
    checked, responses = check_responses([file])
    assert checked.errors == 0 and checked.people == {"drop": 6} and responses is not None
    assert checked.rows == len(pd.read_csv(file))


def test_what_would_be_left_out_is_a_warning(file: Path) -> None:
    table = pd.read_csv(file)
    table.loc[table.index[-1], "response"] = ""
    table.loc[table["session"] == "drop-s000", "rt_ms"] = None
    rare = table[table["session"] == "drop-s001"].iloc[[-1]].assign(stimulus="drop_999", trial=99)
    pd.concat([table, rare]).to_csv(file, index=False)
    checked, _ = check_responses([file])
    text = " ".join(map(str, checked.faults))
    assert checked.errors == 0
    for words in ("no answer", "response time", "fewer than 2 answers, such as drop_999"):
        assert words in text, words


def test_errors_name_the_place_and_outcomes_are_compared(file: Path) -> None:
    checked, _ = check_responses([file], labels={"drop_000": False})
    assert checked.errors == 1 and "drop_000" in str(checked.faults[0])
    table = pd.read_csv(file)
    table["response"] = table["response"].mask(table.index == 5, "maybe")
    table.to_csv(file, index=False)
    checked, responses = check_responses([file])
    assert checked.errors == 1 and "response" in str(checked.faults[0]) and responses is None


def test_the_verb_checks_responses_and_predictions_against_them(
    file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = pd.read_csv(file)
    test = table[table["phase"] == "test"].drop_duplicates("stimulus")
    label = test.set_index("stimulus")["label"]
    rows = pd.DataFrame({"Model": "m", "Readout Type": "B", "Predicted Prob_true": 0.7,
                         "Predicted Outcome": True, "Actual Outcome": label.to_numpy(),
                         "Recorded Outcome": ~label.to_numpy(), "Readout Test Data": "drop",
                         "Stimulus Name": label.index})  # fmt: skip
    rows.to_csv(tmp_path / "m.csv", index=False)
    assert main(["compare", "--check", "--responses", str(file), "--json"]) == 0
    (found,) = json.loads(capsys.readouterr().out)
    assert found["people"] == {"drop": 6} and found["errors"] == 0
    command = ["compare", "--check", str(tmp_path / "m.csv"), "--responses", str(file), "--json"]
    assert main(command) == 1
    _, predictions = json.loads(capsys.readouterr().out)
    assert predictions["errors"] > 0
