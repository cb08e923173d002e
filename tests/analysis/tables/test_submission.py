"""Every kind of fault of a submission is found, with its row and stimulus; none hides another."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from physion.analysis.check import SHOWN, Checked, Reference, check_predictions_file, read_index
from physion.core.errors import BadInputError

STIMULI = [f"pilot_it2_drop_simple_box_{i:04d}" for i in range(6)]
LABELS = {name: i % 2 == 0 for i, name in enumerate(STIMULI)}


def table(**changes: object) -> pd.DataFrame:
    p = [0.9, 0.2, 0.7, 0.4, 0.8, 0.1]
    return pd.DataFrame(
        {
            "Model": "m",
            "Readout Type": "B",
            "Predicted Prob_false": [1 - value for value in p],
            "Predicted Prob_true": p,
            "Predicted Outcome": [value > 0.5 for value in p],
            "Actual Outcome": list(LABELS.values()),
            "Stimulus Name": STIMULI,
            **changes,
        }
    )


def write(folder: Path, rows: pd.DataFrame) -> Path:
    path = folder / "predictions.csv"
    rows.to_csv(path, index=False)
    return path


def check(folder: Path, rows: pd.DataFrame, **reference: object) -> Checked:
    return check_predictions_file(write(folder, rows), Reference(**reference))  # type: ignore[arg-type]


def test_a_good_file_has_no_fault(tmp_path: Path) -> None:
    found = check(tmp_path, table(), labels=LABELS, fitted=["another"])
    assert found.faults == () and found.errors == 0 and found.not_checked == ()
    assert (found.rows, dict(found.models)) == (6, {"m · observed+simulated": 6})


def test_what_cannot_be_checked_is_said(tmp_path: Path) -> None:
    words = " ".join(check(tmp_path, table()).not_checked)
    assert "stimuli" in words and "outcomes" in words and "leakage" in words


@pytest.mark.parametrize(
    ("column", "row", "value", "kind"),
    [
        ("Predicted Prob_true", 2, "1.2", "value"),
        ("Predicted Prob_true", 2, "nan", "value"),
        ("Predicted Prob_true", 2, "", "value"),
        ("Predicted Prob_true", 2, "inf", "value"),
        ("Predicted Outcome", 2, "maybe", "value"),
        ("Actual Outcome", 2, "perhaps", "value"),
        ("Observed Contact", 2, "maybe", "value"),
        ("Model", 2, " ", "value"),
        ("Stimulus Name", 2, "", "value"),
    ],
)
def test_a_bad_value_is_named_with_row_and_stimulus(
    tmp_path: Path, column: str, row: int, value: str, kind: str
) -> None:
    rows = table().astype(str).assign(**{"Observed Contact": ""})
    rows.loc[row, column] = value
    found = check(tmp_path, rows)
    assert found.errors == 1
    fault = next(fault for fault in found.faults if fault.level == "error")
    assert (fault.kind, fault.row) == (kind, row + 1)
    assert fault.stimulus == ("" if column == "Stimulus Name" else STIMULI[row])
    assert f"row {row + 1}" in str(fault) and column.split()[0] in fault.message


def index(**changes: object) -> pd.DataFrame:
    return pd.DataFrame(
        {"trial": [*STIMULI, "fit_0001"], "scenario": "drop",
         "split": ["testing"] * 6 + ["readout"], "digest": [f"d{i}" for i in range(7)],
         "scene_digest": [f"s{i}" for i in range(7)],
         **changes}
    )  # fmt: skip


def changed(value: object, row: int, column: str, rows: pd.DataFrame | None = None) -> pd.DataFrame:
    """Return the good table, or ``rows``, with another value."""
    rows = table() if rows is None else rows
    rows.loc[row, column] = value
    return rows


OUTCOMES = list(LABELS.values())
SEEDS = [table(**{"Dynamics Training Seed": seed}) for seed in (0, 1)]
TWIN = [f"d{i}" for i in range(6)] + ["d4"]
FAULTS: dict[str, tuple[pd.DataFrame, dict[str, object], list[tuple[Any, ...]]]] = {
    "an outcome against its probability": (
        changed(True, 1, "Predicted Outcome"), {}, [("warning", "", 2, STIMULI[1])]),
    "a duplicate, of another look": (
        changed(STIMULI[1] + "-redyellow_img.mp4", 4, "Stimulus Name"), {},
        [("error", "duplicate", 5, "row 2")]),
    "a missing stimulus of one seed": (
        pd.concat([SEEDS[0], SEEDS[1].drop(index=3)]), {"labels": LABELS},
        [("", "missing", None, "1 stimuli"), ("", "missing", None, STIMULI[3])]),
    "a whole scenario is absent": (
        table(), {"labels": {**LABELS, "pilot_towers_x_0001": True}},
        [("warning", "", None, "support")]),
    "unknown stimuli": (
        changed("pilot_it2_drop_simple_box_0099", 7, "Stimulus Name",
                changed("nonsense", 6, "Stimulus Name",
                        pd.concat([table(), table().iloc[:2]], ignore_index=True))),
        {"labels": LABELS}, [("error", "unknown", 7, ""), ("warning", "unknown", 8, "")]),
    "recorded and simulated outcomes that are not the official ones": (
        table(**{"Recorded Outcome": [*OUTCOMES[:5], not OUTCOMES[5]],
                 "Actual Outcome": [not OUTCOMES[0], *OUTCOMES[1:]]}),
        {"labels": LABELS}, [("error", "", 6, ""), ("warning", "", None, "1 rows")]),
    "a motion of a fitting trial": (
        table(), {"index": index(digest=TWIN)}, [("", "leak", 5, "fit_0001")]),
    "a scene of a fitting trial": (
        table(), {"index": index(scene_digest=TWIN)}, [("", "leak", 5, "fit_0001")]),
    "a column split": (
        table(Split=["testing"] * 5 + ["training"]), {"labels": LABELS}, [("", "leak", 6, "")]),
}  # fmt: skip
"""Rows, what they are compared with, and level, kind, row and words of the faults."""


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_has_its_kind_row_and_words(name: str, tmp_path: Path) -> None:
    rows, reference, expected = FAULTS[name]
    faults = check(tmp_path, rows, **reference).faults
    for level, kind, row, words in expected:
        assert [
            fault for fault in faults
            if level in fault.level and kind in fault.kind and fault.row == row
            and words in f"{fault} {fault.stimulus}"
        ], faults  # fmt: skip
    assert len(faults) == len({(row, level) for level, _, row, _ in expected})


@pytest.mark.parametrize(
    ("changes", "columns"),
    [
        ({"Actual Outcome": True}, {"outcome"}),
        ({"Predicted Outcome": True, "Predicted Prob_true": 0.9, "Predicted Prob_false": 0.1},
         {"predicted", "p_contact"}),
        ({"Predicted Prob_true": 0.5, "Predicted Prob_false": 0.5}, {"p_contact"}),
    ],
)  # fmt: skip
def test_constant_columns_of_a_model_and_scenario_are_warnings(
    tmp_path: Path, changes: dict[str, object], columns: set[str]
) -> None:
    # Another model and another scenario vary: these two alone do not make the constant one vary.
    other = table(**{"Model": "n"})
    links = [name.replace("it2_drop_simple_box", "linking_nl1") for name in STIMULI]
    elsewhere = table(**{"Stimulus Name": links})
    rows = pd.concat([table(**changes), other, elsewhere], ignore_index=True)
    found = check(tmp_path, rows)
    assert found.errors == 0
    assert {(fault.kind, fault.column) for fault in found.faults} == {("alike", c) for c in columns}
    words = "all 6 rows of m · observed+simulated, drop"
    assert all(words in fault.message for fault in found.faults)


def test_all_missing_columns_are_named_at_once(tmp_path: Path) -> None:
    found = check(tmp_path, table().drop(columns=["Stimulus Name", "Predicted Prob_true"]))
    assert {fault.column for fault in found.faults} == {"stimulus", "p_contact"}
    assert found.errors == 2 and found.not_checked


def test_a_column_that_stands_twice_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "twice.csv"
    path.write_text(
        "Model,Readout Type,Predicted Prob_true,Predicted Prob_true,Predicted Outcome,"
        f"Actual Outcome,Stimulus Name\nm,B,0.1,0.9,False,True,{STIMULI[0]}\n"
    )
    assert "twice" in check_predictions_file(path).faults[0].message


def test_seeds_and_readouts_are_no_duplicates(tmp_path: Path) -> None:
    rows = pd.concat([*SEEDS, SEEDS[0].assign(**{"Readout Type": "C"})])
    assert check(tmp_path, rows, labels=LABELS).errors == 0


# --- leakage ------------------------------------------------------------------------------------


def test_a_stimulus_of_another_split_leaks(tmp_path: Path) -> None:
    splits = ["testing", "testing", "readout", "training", "testing", "testing", "readout"]
    faults = [
        fault for fault in check(tmp_path, table(), index=index(split=splits)).faults
        if fault.kind == "leak"
    ]  # fmt: skip
    assert [(fault.row, fault.stimulus) for fault in faults] == [(3, STIMULI[2]), (4, STIMULI[3])]
    assert "readout" in faults[0].message and "training" in faults[1].message


def test_a_stimulus_that_the_readout_was_fitted_on_leaks_unless_cross_fitted(
    tmp_path: Path,
) -> None:
    fitted = [STIMULI[0] + "_img.mp4"]
    (fault,) = check(tmp_path, table(), labels=LABELS, fitted=fitted).faults
    assert (fault.kind, fault.row) == ("leak", 1)
    assert not check(tmp_path, table(Fold=0), labels=LABELS, fitted=fitted).faults
    assert check(tmp_path, table(Fold=-1), labels=LABELS, fitted=fitted).errors == 1


def test_an_index_can_be_parquet_csv_or_a_dataset(tmp_path: Path) -> None:
    index().to_parquet(tmp_path / "index.parquet")
    index().to_csv(tmp_path / "index.csv", index=False)
    for path in (tmp_path, tmp_path / "index.parquet", tmp_path / "index.csv"):
        assert list(read_index(path)["trial"]) == [*STIMULI, "fit_0001"]
    (tmp_path / "broken.parquet").write_bytes(b"PAR1 and no more")
    index().drop(columns="split").to_parquet(tmp_path / "short.parquet")
    for name in ("broken.parquet", "short.parquet", "absent.parquet"):
        with pytest.raises(BadInputError, match=name):
            read_index(tmp_path / name)


# --- many faults --------------------------------------------------------------------------------


def test_many_faults_of_one_kind_are_counted(tmp_path: Path) -> None:
    names = [f"nonsense_{i}" for i in range(3 * SHOWN)]
    rows = pd.concat([table()] * (SHOWN // 2), ignore_index=True).assign(**{"Stimulus Name": names})
    found = check(tmp_path, rows, labels=LABELS)
    unknown = [fault for fault in found.faults if fault.kind == "unknown"]
    assert len(unknown) == SHOWN + 1 and f"{2 * SHOWN} more" in unknown[-1].message


def test_one_fault_does_not_hide_another(tmp_path: Path) -> None:
    rows = table().astype(str)
    rows.loc[0, "Predicted Prob_true"] = "2"
    rows.loc[1, "Stimulus Name"] = STIMULI[0]
    rows.loc[3, "Actual Outcome"] = "perhaps"
    kinds = [fault.kind for fault in check(tmp_path, rows, labels=LABELS).faults]
    assert {"value", "duplicate", "missing"} <= set(kinds)


def test_rows_that_end_early_are_faults(tmp_path: Path) -> None:
    path = write(tmp_path, table())
    path.write_text(path.read_text() + "m,B,0.5\n")
    found = check_predictions_file(path)
    assert {fault.row for fault in found.faults} == {7} and found.errors


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b"Model\n", None])
def test_what_is_no_table_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "file.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(BadInputError, match=r"file\.csv"):
        check_predictions_file(path)
