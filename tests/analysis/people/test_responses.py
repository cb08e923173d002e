"""Responses: what is read, refused, dropped and counted; checks of files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from physion.analysis.check import check_responses
from physion.analysis.people.measures import answers_of, mean_over_people
from physion.analysis.people.responses import (
    COPY,
    EXCLUDED,
    LEDGE,
    NO_ANSWER,
    PERSON,
    SESSION_COLUMNS,
    SIMULATED,
    TRIAL_COLUMNS,
    check_labels,
    keep_where,
    pooling_warnings,
    read_official_responses,
    read_responses,
)
from physion.analysis.people.results import read_any_responses
from physion.cli.main import main
from physion.core.errors import BadInputError
from physion.core.tables import check_table, data_dictionary
from support.simulated_people import as_responses, simulate_study, study

SMALL = {"people": 3, "stimuli": 6, "scenarios": ("collide",)}


@pytest.fixture
def tables() -> tuple[pd.DataFrame, pd.DataFrame]:
    return simulate_study(**SMALL)  # type: ignore[arg-type]


def counts(dropped: pd.DataFrame) -> dict[str, tuple[int, int]]:
    return {row.reason: (row.sessions, row.rows) for row in dropped.itertuples()}


def test_a_stimulus_in_two_scenarios_is_one_clear_error() -> None:
    trials, sessions = simulate_study(people=3, stimuli=6, scenarios=("collide", "drop"))
    trials["stimulus"] = trials["stimulus"].replace("drop_003", "collide_003")
    with pytest.raises(BadInputError, match="'collide_003' is in two scenarios, collide and drop"):
        as_responses(trials, sessions)
    # Practice trials may be the same in all scenarios.
    trials, sessions = simulate_study(people=3, stimuli=6, scenarios=("collide", "drop"))
    trials["stimulus"] = trials["stimulus"].str.replace("drop_practice", "collide_practice")
    assert as_responses(trials, sessions).dropped.empty


# --- reading --------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ["csv", "parquet"])
def test_what_was_exported_comes_back(
    tables: tuple[pd.DataFrame, pd.DataFrame], tmp_path: Path, ending: str
) -> None:
    files = []
    for name, table in zip(("trials", "sessions"), tables, strict=True):
        files.append(tmp_path / f"{name}.{ending}")
        if ending == "csv":
            table.to_csv(files[-1], index=False)
        else:
            table.to_parquet(files[-1])
    found = read_responses(*files)
    trials = tables[0]
    assert len(found.trials) == len(trials) == 3 * (6 + 10)
    assert found.dropped.empty and len(found.sessions) == 3
    joined = found.trials.merge(trials, on=["session", "stimulus"], suffixes=("", "_raw"))
    assert (joined["yes"] == (joined["response"] == "yes")).all()
    assert (joined["correct"] == joined["correct_raw"]).all()
    np.testing.assert_allclose(joined["log_rt"], np.log(joined["rt_ms_raw"]))
    assert found.sessions["age"].dtype == "Int64" and len(found.test) == 18


def test_answers_to_own_questions_are_found_next_to_the_export(
    tables: tuple[pd.DataFrame, pd.DataFrame], tmp_path: Path
) -> None:
    trials, sessions = tables
    trials.to_csv(tmp_path / "trials.csv", index=False)
    names = sessions["session"].tolist()
    assert read_any_responses([tmp_path / "trials.csv"]).own == ()
    own = pd.DataFrame({"session": names[1:], "participant": "p", "age": ["x", "y"],
                        "mental_rotation_right": [True, False], "hours": [3, 9]})  # fmt: skip
    own.to_csv(tmp_path / "questions.csv", index=False)
    found = read_any_responses([tmp_path / "trials.csv"])
    assert found.own == ("age", "mental_rotation_right", "hours")
    by_name = found.sessions.set_index("session")["hours"]
    assert by_name[names[1]] == 3 and by_name[names[2]] == 9 and pd.isna(by_name[names[0]])
    sessions.to_csv(tmp_path / "sessions.csv", index=False)
    found = read_any_responses([tmp_path / "trials.csv"], tmp_path / "sessions.csv")
    assert found.own[0] == "own_age" and "age" in found.sessions
    many = pd.DataFrame({"session": range(30), "words": [f"words {i}" for i in range(30)]})
    many.to_csv(tmp_path / "questions.csv", index=False)
    assert read_any_responses([tmp_path / "trials.csv"]).own == ()  # free texts
    pd.concat([own, own]).to_csv(tmp_path / "questions.csv", index=False)
    with pytest.raises(BadInputError, match="two rows"):
        read_any_responses([tmp_path / "trials.csv"])


def test_broken_files_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "trials.parquet"
    path.write_bytes(b"PAR1 not really")
    with pytest.raises(BadInputError, match="parquet"):
        read_responses(path)
    with pytest.raises(BadInputError, match="is not a file"):
        read_responses(tmp_path / "absent.csv")
    empty = pd.DataFrame({column.name: [] for column in TRIAL_COLUMNS})
    with pytest.raises(BadInputError, match="no row"):
        as_responses(empty)


@pytest.mark.parametrize(
    ("column", "value", "words"),
    [
        ("response", "maybe", "row 2 of column 'response' holds 'maybe'; expected yes or no"),
        ("phase", "rest", "familiarization or test"),
        ("trial", "1.5", "whole number"),
        ("trial", "-1", "from 0"),
        ("label", "", "expected a value"),
        ("label", "often", "True or False"),
        ("rt_ms", "fast", "expected a number"),
        ("rt_ms", "inf", "expected a number"),
        ("participant", "", "expected a value"),
    ],
)
def test_a_cell_that_breaks_its_column_is_named(
    tables: tuple[pd.DataFrame, pd.DataFrame], column: str, value: str, words: str
) -> None:
    trials = tables[0].astype(object)
    trials.loc[1, column] = value
    with pytest.raises(BadInputError, match=words):
        as_responses(trials)


def test_times_numbers_and_choices_of_sessions_are_checked(
    tables: tuple[pd.DataFrame, pd.DataFrame],
) -> None:
    for column, value in (("started_at", "yesterday"), ("difficulty", 6), ("age", 200)):
        sessions = tables[1].astype(object)
        sessions.loc[0, column] = value
        with pytest.raises(BadInputError, match=column):
            check_table(sessions, SESSION_COLUMNS, "sessions")
    with pytest.raises(BadInputError, match="lacks the column"):
        check_table(tables[1].drop(columns="simulated"), SESSION_COLUMNS, "sessions")


def test_the_data_dictionary_says_all_of_the_schema() -> None:
    for columns in (TRIAL_COLUMNS, SESSION_COLUMNS):
        entries = json.loads(json.dumps(data_dictionary(columns)))
        assert [entry["name"] for entry in entries] == [column.name for column in columns]
        assert len({entry["name"] for entry in entries}) == len(entries)
        assert all(entry["about"] and entry["kind"] for entry in entries)
        assert all(entry["choices"] for entry in entries if entry["kind"] == "choice")


# --- cleaning: nothing goes without being counted -----------------------------------------------


def test_copies_and_missing_answers_are_dropped_and_counted(
    tables: tuple[pd.DataFrame, pd.DataFrame],
) -> None:
    trials = tables[0].astype(object)
    trials.loc[[10, 11], ["response", "correct"]] = ""
    trials = pd.concat([trials, trials.iloc[[20, 30, 31]]])
    found = as_responses(trials)
    assert counts(found.dropped) == {NO_ANSWER: (1, 2), COPY: (1, 3)}
    assert len(found.trials) == 3 * 16 - 2


def test_simulated_participants_are_left_out_and_counted(
    tables: tuple[pd.DataFrame, pd.DataFrame], tmp_path: Path
) -> None:
    trials, sessions = tables
    sessions.loc[1, "simulated"] = True
    trials.to_csv(tmp_path / "t.csv", index=False)
    sessions.to_csv(tmp_path / "s.csv", index=False)
    found = read_responses(tmp_path / "t.csv", tmp_path / "s.csv")
    assert counts(found.dropped) == {SIMULATED: (1, 16)} and len(found.sessions) == 2
    trials.assign(simulated=trials["session"] == "collide-s002").to_csv(tmp_path / "t.csv")
    marked = read_responses(tmp_path / "t.csv")  # the mark travels with every row
    assert counts(marked.dropped) == {SIMULATED: (1, 16)}
    kept = read_responses(tmp_path / "t.csv", tmp_path / "s.csv", participants="all")
    assert kept.dropped.empty and len(kept.sessions) == 3
    assert kept.simulated_sessions == {"collide-s001", "collide-s002"}
    rehearsal = read_responses(tmp_path / "t.csv", tmp_path / "s.csv", participants="simulated")
    assert set(rehearsal.trials["session"]) == kept.simulated_sessions
    assert counts(rehearsal.dropped) == {PERSON: (1, 16)}
    tables[0].to_csv(tmp_path / "people.csv", index=False)
    with pytest.raises(BadInputError, match="no simulated participant was found"):
        read_responses(tmp_path / "people.csv", participants="simulated")


def turned_label(trials: pd.DataFrame) -> pd.DataFrame:
    labels = trials.drop(columns="correct")
    at = labels.index[labels["stimulus"] == "collide_001"][0]
    labels.loc[at, "label"] = not labels.loc[at, "label"]
    return labels


@pytest.mark.parametrize(
    ("change", "of_sessions", "words"),
    [
        (lambda t: t.assign(correct=~t["correct"].astype(bool)), None, "disagree"),
        (turned_label, None, "two labels"),
        (lambda t: t.assign(participant=["a", *"b" * (len(t) - 1)]), None, "two participants"),
        (lambda t: t, lambda s: s.iloc[1:], "missing from the sessions table"),
        (lambda t: t, lambda s: s.assign(scenario="drop"), "missing from the sessions table"),
        (lambda t: t, lambda s: pd.concat([s, s]), "stands in two rows"),
        (lambda t: pd.concat([t.iloc[[12]].assign(rt_ms=5000.0, trial=99), t]), None,
         r"two answers to trial .*keep one row"),
        (lambda t: pd.concat([t.iloc[[12]].assign(rt_ms=5000.0, stimulus="collide_099"), t]), None,
         r"two answers to trial .*keep one row"),
    ],
)  # fmt: skip
def test_contradictions_are_refused(
    tables: tuple[pd.DataFrame, pd.DataFrame], change: Any, of_sessions: Any, words: str
) -> None:
    trials, sessions = tables
    with pytest.raises(BadInputError, match=words):
        as_responses(change(trials), of_sessions and of_sessions(sessions))


def test_other_labels_are_refused(tables: tuple[pd.DataFrame, pd.DataFrame]) -> None:
    trials, _ = tables
    truth = dict(zip(trials["stimulus"], trials["label"], strict=True))
    check_labels(as_responses(trials), truth)
    with pytest.raises(BadInputError, match="ends otherwise"):
        check_labels(as_responses(trials), truth | {"collide_001_img": not truth["collide_001"]})


def test_stimuli_are_left_out_by_list_and_as_ledges(
    tables: tuple[pd.DataFrame, pd.DataFrame],
) -> None:
    ledge = "pilot_it2_rollingSliding_simple_ledge_box_0001"
    trials = tables[0].replace("collide_002", f"{ledge}_img")
    found = as_responses(trials).drop_stimuli(["collide_001"])
    assert counts(found.dropped) == {LEDGE: (3, 3), EXCLUDED: (3, 3)}
    assert len(found.test) == 3 * 4
    kept = as_responses(trials).drop_stimuli(ledge=False)
    assert ledge in set(kept.trials["stimulus"]) and kept.dropped.empty


# --- the official columns -----------------------------------------------------------------------

NAMES = ("pilot_it2_collision_simple_box_1_dis_1_occ_0001", "pilot_it2_collision_yeet_box_0004")


def official_file(folder: Path, name: str, **columns: object) -> Path:
    rows = {
        "gameID": ["g1", "g1", "g2", "g2"],
        "trialNum": [1, 0, 0, 1],
        "prolificIDAnon": ["p", "p", "q", "q"],
        "stim_ID": [f"{NAMES[0]}_img", f"{NAMES[1]}_img"] * 2,
        "response": ["YES", "NO", "NO", "NO"],
        "target_hit_zone_label": [True, True, True, True],
        "correct": [True, False, False, False],
        "choices": ["['YES' 'NO']"] * 2 + ['["NO","YES"]'] * 2,
        "rt": [3500.0, 4500.0, 2400.0, np.nan],
    }
    path = folder / name
    pd.DataFrame(rows | columns).to_csv(path)
    return path


def test_official_columns_are_read_with_the_official_offset(tmp_path: Path) -> None:
    test = official_file(tmp_path, "human_responses-collision_pilot-production_2_testing.csv")
    practice = official_file(
        tmp_path,
        "familiarization_human_responses-collision_pilot-production_2_testing.csv",
        stim_ID=["familiarization_0001", "familiarization_0002"] * 2,
    )
    found = read_official_responses([test, practice])
    assert len(found.trials) == 8 and set(found.trials["scenario"]) == {"collide"}
    assert (found.trials["phase"] == "familiarization").sum() == 4
    rows = found.test
    assert rows["rt_ms"].tolist() == pytest.approx([2000, 1000, -100, np.nan], nan_ok=True)
    assert np.isnan(rows["log_rt"].to_numpy()).tolist() == [False, False, True, True]
    assert rows["stimulus"].tolist() == [NAMES[1], NAMES[0], NAMES[0], NAMES[1]]
    assert rows["buttons"].tolist() == ["yes-no"] * 2 + ["no-yes"] * 2
    assert rows["participant"].tolist() == ["p", "p", "q", "q"]


def test_answers_that_are_taken_together_give_a_warning(tmp_path: Path) -> None:
    plain = official_file(tmp_path, "human_responses-collision_pilot.csv")
    names = [f"{name.replace('_0', '-redyellow_0')}_img" for name in NAMES[:2]] * 2
    red = official_file(tmp_path, "a.csv", gameID=["g3", "g3", "g4", "g4"], stim_ID=names)
    assert pooling_warnings(read_official_responses([plain]).test) == []
    both = read_official_responses([plain, red])
    (warning,) = pooling_warnings(both.test)
    assert "collide: answers to free and to red and yellow objects" in warning
    assert pooling_warnings(keep_where(both, ["look=redyellow"]).test) == []
    test = both.test.assign(look="free")
    test.loc[test["session"] == "g3", "scenario"] = "drop"
    (warning,) = pooling_warnings(test)
    assert warning.startswith("1 of 2 participants answered several scenarios")


def test_official_files_of_any_name_know_their_scenario_by_their_stimuli(tmp_path: Path) -> None:
    path = official_file(tmp_path, "a.csv", condition=["prediction", "prediction"] * 2)
    assert set(read_official_responses([path]).trials["scenario"]) == {"collide"}
    strange = official_file(tmp_path, "b.csv", stim_ID=["x_0001", "x_0002"] * 2)
    with pytest.raises(BadInputError, match="name it human_responses-SCENARIO"):
        read_official_responses([strange])
    named = strange.rename(tmp_path / "human_responses-towers_pilot.csv")
    assert set(read_official_responses([named]).trials["scenario"]) == {"support"}
    with pytest.raises(BadInputError, match="'rt' holds"):
        read_official_responses([official_file(tmp_path, "c.csv", rt=["soon"] * 4)])
    with pytest.raises(BadInputError, match="no file"):
        read_official_responses([])


# --- arrays --------------------------------------------------------------------------------


def test_answers_as_arrays_hold_what_the_rows_say() -> None:
    responses = study(people=4, stimuli=7, scenarios=("collide", "roll"), seed=3)
    gone = responses.test.index[[3, 20]]
    test = responses.test.drop(index=gone)
    answers = answers_of(test, "collide")
    assert answers.yes.shape == (4, 7) and np.isnan(answers.yes).sum() == len(
        set(gone) & set(responses.test.index[responses.test["scenario"] == "collide"])
    )
    rows = test[test["scenario"] == "collide"]
    for row in rows.itertuples():
        cell = answers.sessions.index(row.session), answers.stimuli.index(row.stimulus)
        assert answers.yes[cell] == row.yes and answers.correct[cell] == row.correct
        assert answers.log_rt[cell] == row.log_rt
    by_hand = rows.groupby("stimulus")["yes"].mean()
    np.testing.assert_allclose(answers.p_yes(), by_hand.loc[list(answers.stimuli)])
    weights = np.array([[2.0, 0, 1, 1]])
    drawn = np.repeat(answers.yes, weights[0].astype(int), axis=0)
    np.testing.assert_allclose(mean_over_people(answers.yes, weights)[0], np.nanmean(drawn, axis=0))
    with pytest.raises(BadInputError, match="no answer"):
        answers_of(test, "drape")


def test_a_session_of_two_scenarios_is_an_error() -> None:
    trials, sessions = simulate_study(people=2, stimuli=6, scenarios=("collide", "drop"))
    both = trials["session"].replace("drop-s000", "collide-s000")
    with pytest.raises(BadInputError, match="two participants or scenarios"):
        as_responses(trials.assign(session=both), sessions)


# --- checks --------------------------------------------------------------------------------


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
