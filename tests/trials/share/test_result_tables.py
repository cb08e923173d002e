"""Tables of predictions for the notebooks of the study."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from physion.cli.main import main as cli
from physion.core.errors import BadInputError
from physion.trials.share.result_tables import OFFICIAL_COLUMNS, export_result_tables

DATASET_COLUMNS = ("Encoder Training Dataset", "Dynamics Training Dataset", "Readout Train Data")
NOTEBOOK_SCENARIOS = {
    "collide": "collision",
    "contain": "containment",
    "dominoes": "dominoes",
    "drape": "clothiness",
    "drop": "drop",
    "link": "linking",
    "roll": "rollingsliding",
    "support": "towers",
}


def table(path: Path) -> Path:
    rows = [
        {
            "model": "m",
            "readout": "full",
            "protocol": ("only", "all-but")[number % 2],
            "seed": "0",
            "stimulus": f"{ours}_testing_0000",
            "scenario": ours,
            "p_contact": "0.6666666666666666",
            "outcome": number % 2 == 0,
            "train_accuracy": "0.5",
            "decision": "logistic",
        }
        for number, ours in enumerate(NOTEBOOK_SCENARIOS)
    ]
    path.parent.mkdir(parents=True, exist_ok=True)
    pd.DataFrame(rows).to_csv(path, index=False)
    return path


def test_a_training_on_one_scenario_has_its_official_name(tmp_path: Path) -> None:
    rows = pd.read_csv(table(tmp_path / "in" / "one.csv"))
    rows = rows.assign(protocol="one", dynamics_training_dataset="drape")
    rows.to_csv(tmp_path / "in" / "one.csv", index=False)
    (path,) = export_result_tables(tmp_path / "in", tmp_path / "out")
    found = pd.read_csv(path)
    same = found["Readout Test Data"] == found["Dynamics Training Dataset"]
    assert found["Dynamics Training Dataset"].nunique() == 1 and same.sum() == 1
    assert rows["scenario"][same].item() == "drape"


def process_model_dataframe(frame: pd.DataFrame) -> pd.DataFrame:
    """``process_model_dataframe`` of ``analysis/analysis_helpers.py`` of the study, its selections.

    cogtoolslab/physics-benchmarking-neurips2021 at commit fd02f3f.
    """
    frame["correct"] = frame["Actual Outcome"] == frame["Predicted Outcome"]
    frame = frame.replace("rollslide", "rollingsliding").replace("cloth", "clothiness")
    frame["Canon Stimulus Name"] = frame["Stimulus Name"].apply(
        lambda name: "".join(name.split("-redyellow"))
    )
    for col in DATASET_COLUMNS:
        frame[col + " Type"] = frame[col]
        frame.loc[frame[col] == frame["Readout Test Data"], col + " Type"] = "same"
        others = ["no_" + name for name in frame["Readout Test Data"]]
        frame.loc[frame[col] == others, col + " Type"] = "all_but_this"
    return frame


def test_the_notebooks_find_every_scenario(tmp_path: Path) -> None:
    table(tmp_path / "evaluated/predictions/m.csv")
    (made,) = export_result_tables(tmp_path / "evaluated", tmp_path / "models")
    frame = pd.read_csv(made)
    assert frame["Encoder Training Dataset"].unique().tolist() == ["none"]
    found = process_model_dataframe(frame.copy())  # pandas 3 refuses texts in an empty column
    for number, (ours, theirs) in enumerate(NOTEBOOK_SCENARIOS.items()):
        (row,) = found[found["Readout Test Data"] == theirs].to_dict("records")
        assert row["Canon Stimulus Name"] == f"{ours}_testing_0000"
        assert row["Readout Train Data Type"] == "same"
        wanted = "all_but_this" if number % 2 else "same"
        assert row["Dynamics Training Dataset Type"] == wanted
        assert row["correct"] == (number % 2 == 0)
        assert (row["Readout Type"], row["Model"], row["Train Accuracy"]) == ("A", "m", 0.5)
        assert row["Predicted Prob_false"] + row["Predicted Prob_true"] == 1
    assert list(frame) == list(OFFICIAL_COLUMNS)
    assert "0.6666666666666666" in made.read_text()  # digits stay


def test_other_files_are_left_out_and_clashes_named(tmp_path: Path) -> None:
    (tmp_path / "e").mkdir()
    (tmp_path / "e/other.csv").write_text("a,b\n1,2\n")
    with pytest.raises(BadInputError, match="no table of predictions"):
        export_result_tables(tmp_path / "e", tmp_path / "out")
    assert not (tmp_path / "out").exists()
    table(tmp_path / "e/one/m.csv")
    table(tmp_path / "e/two/m.csv")
    with pytest.raises(BadInputError, match="same name"):
        export_result_tables(tmp_path / "e", tmp_path / "out")
    with pytest.raises(BadInputError, match="outside"):
        export_result_tables(tmp_path / "e", tmp_path / "e/out")
    (tmp_path / "e/empty.csv").write_text("")
    with pytest.raises(BadInputError, match=r"empty\.csv is not a table"):
        export_result_tables(tmp_path / "e", tmp_path / "out")


def test_the_verb(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    table(tmp_path / "e/predictions/m.csv")
    words = ["export", str(tmp_path / "e"), str(tmp_path / "out"), "--layout", "result-tables"]
    assert cli(words) == 0
    assert "m.csv" in capsys.readouterr().out and (tmp_path / "out/m.csv").is_file()
    assert cli([*words, "--split", "testing"]) == 2
