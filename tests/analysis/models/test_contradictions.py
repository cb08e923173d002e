"""Tables that contradict each other are errors or warnings, on the page and on the terminal."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from physion.analysis import Bootstrap, compare_scores, read_humans, read_labels
from physion.analysis.compare import all_results
from physion.analysis.comparison import check_coverage
from physion.analysis.tables import check_predictions, name_models
from physion.cli.main import main
from physion.core.errors import BadInputError, UnknownNameError

QUICK = Bootstrap(resamples=20)
STEM = "pilot_it2_drop_simple_box"
COUNT = 30
LABELS = {f"{STEM}_{k:04d}": k % 2 == 0 for k in range(COUNT)}


def humans() -> pd.DataFrame:
    accuracy = np.random.default_rng(0).integers(9, 20, COUNT) / 20
    return pd.DataFrame(
        {"stimulus": list(LABELS), "scenario": "drop", "accuracy": accuracy, "count": 20.0}
    )


def predictions(right: int = 24, model: str = "m") -> pd.DataFrame:
    """Return predictions of which the first ``right`` are right."""
    truth = np.array(list(LABELS.values()))
    predicted = truth ^ (np.arange(COUNT) >= right)
    return pd.DataFrame(
        {"Model": model, "Readout Type": "B", "Predicted Outcome": predicted,
         "Predicted Prob_true": np.where(predicted, 0.8, 0.3), "Actual Outcome": truth,
         "Stimulus Name": list(LABELS)}
    )  # fmt: skip


def warnings_of(table: pd.DataFrame, labels: dict[str, bool] = LABELS) -> tuple[str, ...]:
    return compare_scores(table, humans(), labels, bootstrap=QUICK).warnings


def test_consistent_tables_give_no_warning() -> None:
    assert warnings_of(predictions()) == ()
    half = predictions()
    half.loc[3, ["Predicted Prob_true", "Predicted Outcome"]] = [0.5, True]
    assert warnings_of(half) == ()


def test_an_outcome_against_its_probability_is_reported() -> None:
    table = predictions()
    table.loc[[4, 9], "Predicted Prob_true"] = 1 - table.loc[[4, 9], "Predicted Prob_true"]
    (warning,) = warnings_of(table)
    assert "m · observed+simulated" in warning and f"{STEM}_0004" in warning
    assert "contradicts p_contact in 2 of 30 rows" in warning
    # Another threshold contradicts as well, but is no mistake.
    p = np.where(predictions()["Predicted Outcome"], 0.95, 0.7)
    (warning,) = warnings_of(predictions().assign(**{"Predicted Prob_true": p}))
    assert "in 15 of 30 rows" in warning
    with pytest.raises(BadInputError, match=r"in 30 of 30 rows.*probability of a contact"):
        warnings_of(
            predictions().assign(**{"Predicted Outcome": ~predictions()["Predicted Outcome"]})
        )


def test_opposite_labels_are_refused() -> None:
    opposite = {name: not value for name, value in LABELS.items()}
    with pytest.raises(BadInputError, match=r"drop: .* in 30 of 30 stimuli: .*opposite"):
        warnings_of(predictions(), opposite)
    # More than half differ, but chance could do that: a warning.
    some = {name: value ^ (k < 17) for k, (name, value) in enumerate(LABELS.items())}
    (warning,) = warnings_of(predictions(), some)
    assert "in 17 of 30 stimuli" in warning
    few = {name: value ^ (k < 15) for k, (name, value) in enumerate(LABELS.items())}
    assert warnings_of(predictions(), few) == ()


def test_answers_far_below_guessing_are_reported() -> None:
    (warning,) = warnings_of(predictions(2))
    assert "right in 7% of 30 stimuli" in warning
    # Always no is wrong for half of the stimuli, which is what guessing gives.
    never = predictions().assign(**{"Predicted Outcome": False, "Predicted Prob_true": 0.1})
    assert warnings_of(never) == ()


def test_a_comparison_on_few_stimuli_is_reported() -> None:
    (warning,) = warnings_of(predictions().head(9))
    assert "on only 9 stimuli" in warning
    assert warnings_of(predictions().head(10)) == ()


def test_missing_labels_of_predicted_stimuli_are_reported() -> None:
    known = dict(list(LABELS.items())[:25])
    (warning,) = warnings_of(predictions(), known)
    assert "drop: 5 of 30 stimuli" in warning and f"{STEM}_0025" in warning


def test_people_that_lack_stimuli_with_a_label_are_reported() -> None:
    assert check_coverage(humans(), LABELS) == []
    more = {**LABELS, f"{STEM}_0099": True, "pilot_towers_nb2_x_0001": True}
    (warning,) = check_coverage(humans(), more)
    assert "drop: 1 of 31 stimuli" in warning and f"{STEM}_0099" in warning
    ledge = {**LABELS, "pilot_it2_rollingSliding_simple_ledge_box_0001": True}
    assert check_coverage(humans(), ledge) == []


def test_a_stimulus_in_two_scenarios_is_refused() -> None:
    table = pd.concat([predictions(), predictions(model="n")]).assign(
        **{"Stimulus Name": [f"own {k % COUNT}" for k in range(2 * COUNT)],
           "Readout Test Data": ["drop"] * COUNT + ["roll"] * COUNT}
    )  # fmt: skip
    with pytest.raises(BadInputError, match="'own 0' is predicted in two scenarios, drop and roll"):
        name_models(check_predictions(table))


def test_a_misspelt_stimulus_to_exclude_is_refused() -> None:
    rows = name_models(check_predictions(predictions()))
    some = [f"{STEM}_0003", "pilot_towers_nb2_fr015_SJ010_mono0_dis0_occ0_tdwroom_0001"]
    results = all_results(rows, humans(), LABELS, exclude=some, bootstrap=QUICK)
    assert results.comparison.stimuli["stimulus"].nunique() == COUNT - 1
    for wrong in (f"{STEM}_003", "pilot_it2_drop_simpel_box_0003"):
        with pytest.raises(UnknownNameError, match=f"'{wrong}'; closest: {STEM}"):
            all_results(rows, humans(), LABELS, exclude=[wrong], bootstrap=QUICK)


def write(folder: Path, table: pd.DataFrame) -> Path:
    table.to_csv(folder / "m.csv", index=False)
    return folder / "m.csv"


def cut_study(official: Path, folder: Path) -> Path:
    """Return a copy of the official people whose table of Drop was cut."""
    for name in ("humans", "stimuli", "results"):
        shutil.copytree(official / name, folder / name)
    (table,) = (folder / "humans").glob("*drop*.csv")
    table.write_text("".join(table.read_text().splitlines(keepends=True)[:121]))
    return folder / "humans"


@pytest.mark.nightly
@pytest.mark.slow
def test_a_cut_official_table_is_reported_on_page_and_terminal(
    official: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    people = cut_study(official, tmp_path)
    assert len(read_humans(people)) == 1144 - 30
    labels = read_labels(official / "stimuli" / "stimulus_names_and_labels.csv")
    drop = [name for name in labels if name.startswith("pilot_it2_drop")]
    truth = np.array([labels[name] for name in drop])
    table = pd.DataFrame(
        {"Model": "m", "Readout Type": "B", "Predicted Outcome": truth, "Actual Outcome": truth,
         "Predicted Prob_true": truth * 0.8 + 0.1, "Stimulus Name": drop}
    )  # fmt: skip
    command = ["compare", str(write(tmp_path, table)), "--humans", str(people)]
    command += ["--out", str(tmp_path / "out"), "--resamples", "20"]
    assert main(command) == 0
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "physion: warning: drop: 30 of 150 stimuli" in error
    text = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "<strong>Warnings</strong>" in text and "drop: 30 of 150 stimuli" in text
