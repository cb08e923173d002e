"""People's answers from the official files: golden values, and every kind of broken file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from physion.analysis.statistics import agreement
from physion.analysis.tables import (
    read_human_zone,
    read_humans,
    read_labels,
    read_stimulus_list,
    scenario_name,
    with_labels,
)
from physion.core.errors import BadInputError, PhysionError, UnknownNameError
from physion.core.names import OFFICIAL_SCENARIOS, SCENARIOS, canonical_name, is_ledge, scenario_of

PLAIN = "human_accuracy-dominoes_pilot-production_1_testing.csv"
RED = "human_accuracy-dominoes-redyellow_pilot-production_2_testing.csv"
COLLIDE = "human_accuracy-collision_pilot-production_2_testing.csv"
HEADER = "stim_ID,correct,c\n"


def folder_with(folder: Path, **files: str) -> Path:
    names = {"plain": PLAIN, "red": RED, "collide": COLLIDE}
    for name, text in files.items():
        (folder / names[name]).write_text(text)
    return folder


# --- against the official summary -----------------------------------------------------------


@pytest.fixture(scope="module")
def people(official: Path) -> pd.DataFrame:
    labels = read_labels(official / "stimuli" / "stimulus_names_and_labels.csv")
    return with_labels(read_humans(official / "humans"), labels)


@pytest.fixture(scope="module")
def summary(official: Path) -> pd.DataFrame:
    table = pd.read_csv(official / "results" / "human_accuracy_by_scenario.csv")
    return table.assign(scenario=table["scenario"].map(OFFICIAL_SCENARIOS)).set_index("scenario")


def test_official_stimuli_are_all_there_and_labelled(people: pd.DataFrame) -> None:
    counts = people["scenario"].value_counts()
    assert counts.drop("roll").eq(150).all() and counts["roll"] == 94
    assert set(counts.index) == set(SCENARIOS)
    assert people["label"].notna().all()
    assert not people["stimulus"].map(is_ledge).any()
    assert (people["stimulus"].map(scenario_of) == people["scenario"]).all()


FEWER = {"dominoes": 8, "support": 1, "collide": 2, "contain": 2}
FEWER |= {"drop": 1, "link": 2, "roll": 7, "drape": 1}


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_the_summary_is_about_the_same_stimuli_and_fewer_people(
    people: pd.DataFrame, summary: pd.DataFrame, scenario: str
) -> None:
    rows = people[people["scenario"] == scenario]
    fewer = FEWER[scenario]
    total = (rows["accuracy"] * rows["count"]).sum()
    kept = summary.loc[scenario, "obs_mean"] * len(rows) * (rows["count"].iloc[0] - fewer)
    # Whole numbers of correct answers on both sides, and those left out got a possible share.
    assert total == pytest.approx(round(total), abs=1e-6)
    assert kept == pytest.approx(round(kept), abs=1e-6)
    assert 0.4 < (total - kept) / fewer / len(rows) < 0.9


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_binomial_reliability_matches_the_official_split_halves(
    people: pd.DataFrame, official: Path, scenario: str
) -> None:
    table = pd.read_csv(official / "results" / "human_pairwiseCorrs_by_scenario.csv")
    table = table.assign(scenario=table["scenario"].map(OFFICIAL_SCENARIOS)).set_index("scenario")
    rows = people[people["scenario"] == scenario]
    whole = agreement.reliability(rows["p_yes"], rows["count"])
    assert whole / (2 - whole) == pytest.approx(table.loc[scenario, "r_mean"], abs=0.004)


def test_zone_is_read(official: Path) -> None:
    zone = read_human_zone(official / "results" / "human_accuracy_by_scenario.csv")
    collide = zone.set_index("scenario").loc["collide"]
    assert (round(collide["low"], 4), round(collide["high"], 4)) == (0.7133, 0.88)
    assert set(zone["scenario"]) == set(SCENARIOS)


def test_readout_labels_are_refused_as_labels(official: Path) -> None:
    with pytest.raises(BadInputError, match="lacks the column"):
        read_labels(official / "stimuli" / "readout_labels.csv")


# --- names --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "spelling",
    ["a-redyellow_0001", "a_0001_img", "a_0001_img.mp4", "a-redyellow_0001_img", " a_0001.hdf5",
     "m/a_0001_img.webm", "C:\\m\\a_0001.npy"],
)  # fmt: skip
def test_canonical_name(spelling: str) -> None:
    assert canonical_name(spelling) == "a_0001"


def test_scenario_names() -> None:
    assert [scenario_name(name) for name in ("towers", "Support", "clothiness")] == [
        "support",
        "support",
        "drape",
    ]
    assert scenario_of("test_of_mine_1") is None
    with pytest.raises(UnknownNameError, match="collide"):
        scenario_name("collde")


def test_stimulus_list(tmp_path: Path) -> None:
    path = tmp_path / "list.txt"
    path.write_text("a-redyellow_1\n\n b_2\n")
    assert read_stimulus_list(path) == ["a_1", "b_2"]
    path.write_text("\n")
    with pytest.raises(BadInputError, match="names no stimulus"):
        read_stimulus_list(path)
    with pytest.raises(BadInputError, match="cannot be read"):
        read_stimulus_list(tmp_path / "none.txt")


# --- reading --------------------------------------------------------------------------------


def test_fraction_of_yes_follows_from_accuracy_and_label(tmp_path: Path) -> None:
    humans = read_humans(folder_with(tmp_path, collide=HEADER + "a,.9,10\nb,.9,10\nc,.9,10\n"))
    found = with_labels(humans, {"a_img": True, "b": False})
    assert np.allclose(found["p_yes"], [0.9, 0.1, np.nan], equal_nan=True)
    assert list(found["scenario"]) == ["collide"] * 3


def test_both_looks_of_dominoes(tmp_path: Path) -> None:
    folder_with(tmp_path, plain=HEADER + "d_1,.8,30\nd_2,.5,30\n")
    folder_with(tmp_path, red=HEADER + "d-redyellow_1,.4,10\n")
    accuracy = {
        look: dict(zip(table["stimulus"], table["accuracy"], strict=True))
        for look in ("plain", "redyellow", "pooled")
        for table in [read_humans(tmp_path, dominoes=look)]  # type: ignore[arg-type]
    }
    assert accuracy["plain"] == {"d_1": 0.8, "d_2": 0.5}
    assert accuracy["redyellow"] == {"d_1": 0.4}
    assert accuracy["pooled"] == pytest.approx({"d_1": 0.7, "d_2": 0.5})
    pooled = read_humans(tmp_path, dominoes="pooled").set_index("stimulus")
    assert pooled.loc["d_1", "count"] == 40


def test_an_absent_look_is_named(tmp_path: Path) -> None:
    folder_with(tmp_path, red=HEADER + "d-redyellow_1,.4,10\n")
    with pytest.raises(BadInputError, match="look 'redyellow' only"):
        read_humans(tmp_path)
    with pytest.raises(BadInputError, match="choose plain"):
        read_humans(tmp_path, dominoes="blue")  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("stim_ID,correct\na,.9\n", "lacks the column.*c"),
        (HEADER, "no rows"),
        ("", "not a CSV table"),
        (HEADER + "a,1.2,10\n", "row 1 of column 'correct' holds '1.2'"),
        (HEADER + "a,.9,10\nb,-.1,10\n", "row 2 of column 'correct'"),
        (HEADER + "a,nan,10\n", "'nan'"),
        (HEADER + "a,,10\n", "''"),
        (HEADER + "a,.9,0\n", "column 'c'"),
        (HEADER + "a,.9,10\na_img,.8,10\n", "'a' stands in two rows"),
        ('stim_ID,correct,c\n"a,.9', "not a CSV table"),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(BadInputError, match=message):
        read_humans(folder_with(tmp_path, collide=text))


def test_bad_folders_and_names_of_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(BadInputError, match="not a folder"):
        read_humans(tmp_path / "none")
    with pytest.raises(BadInputError, match="holds no human_accuracy"):
        read_humans(tmp_path)
    (tmp_path / COLLIDE).write_bytes(bytes(range(256)))
    with pytest.raises(BadInputError, match="collision"):
        read_humans(tmp_path)
    (tmp_path / COLLIDE).unlink()
    (tmp_path / "human_accuracy-juggling_pilot-x.csv").write_text(HEADER + "a,.9,10\n")
    with pytest.raises(PhysionError, match="juggling"):
        read_humans(tmp_path)


def test_bad_labels_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "labels.csv"
    path.write_text("stim_ID,label\na,maybe\n")
    with pytest.raises(BadInputError, match="expected True or False"):
        read_labels(path)
    path.write_text("stim_ID,label\na,True\na-redyellow,False\n")
    with pytest.raises(BadInputError, match="two rows"):
        read_labels(path)
    path.write_text("stim_ID,label\na_img,TRUE\nb,0\n")
    assert read_labels(path) == {"a": True, "b": False}
