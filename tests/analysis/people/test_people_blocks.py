"""Responses of sessions that run through several scenarios, one block each."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import pytest

from physion.analysis.check import check_responses
from physion.analysis.people.exclusions import expected_by_session, flag_sessions
from physion.analysis.people.measures import accuracy_by_scenario
from physion.analysis.people.responses import TRIAL_COLUMNS, clean, scenario_set, scenarios_in
from physion.analysis.people.results import analyse_people
from physion.analysis.tables import check_table
from physion.core.errors import BadInputError

BLOCKS = {"collide": 6, "support": 6}


def session_rows(person: int, answered: int = 12) -> list[dict[str, object]]:
    """Return the answers of a person, whose blocks begin with either scenario in turn."""
    order = list(BLOCKS) if person % 2 else list(BLOCKS)[::-1]
    found: list[dict[str, object]] = []
    for block, scenario in enumerate(order):
        for index in range(BLOCKS[scenario]):
            label = index % 2 == 0
            right = (person * 7 + index * 5 + block) % 4 != 0
            found.append({
                "participant": f"p{person}", "session": f"s{person}", "scenario": scenario,
                "stimulus": f"{scenario}_{index}", "phase": "test", "trial": len(found),
                "response": "yes" if label == right else "no", "label": label,
                "simulated": False, "rt_ms": 400 + 10 * index + person, "block": block,
            })  # fmt: skip
    return found[:answered]


def table(rows: list[dict[str, object]]) -> pd.DataFrame:
    return check_table(pd.DataFrame(rows), TRIAL_COLUMNS, "here")


def sessions_of(people: range) -> pd.DataFrame:
    orders = {0: "support collide", 1: "collide support"}
    return pd.DataFrame(
        {
            "participant": [f"p{person}" for person in people],
            "session": [f"s{person}" for person in people],
            "scenario": [orders[person % 2] for person in people],
            "simulated": False,
        }
    )


def test_a_session_of_several_blocks_is_one_session_in_any_order() -> None:
    people = range(8)
    rows = [row for person in people for row in session_rows(person)]
    for sessions in (None, sessions_of(people)):
        responses = clean(table(rows), sessions)
        assert set(responses.sessions["scenario"]) == {"support + collide"}
        flags = flag_sessions(responses)
        assert len(flags) == 8 and not flags["repeated"].any() and not flags["incomplete"].any()
        assert list(flags["trials"]) == [12] * 8 and list(flags["expected"]) == [12] * 8
    assert scenario_set(["collide", "support"]) == "support + collide"
    assert scenarios_in("support + collide") == ["support", "collide"]


def test_a_session_that_ended_in_its_first_block_is_incomplete() -> None:
    rows = [row for person in range(8) for row in session_rows(person, 6 if person == 3 else 12)]
    responses = clean(table(rows), sessions_of(range(8)))
    flags = flag_sessions(responses).set_index("session")
    assert list(flags.index[flags["incomplete"]]) == ["s3"]
    assert flags.loc["s3", "missing"] == 6


def test_the_list_of_a_session_names_the_stimuli_drawn_for_it() -> None:
    rows = [row for person in range(8) for row in session_rows(person)]
    rows = [row for row in rows if row["stimulus"] != f"collide_{int(str(row['session'])[1:]) % 6}"]
    responses = clean(table(rows), sessions_of(range(8)))
    drawn = {
        str(name): frozenset(part["stimulus"]) for name, part in responses.test.groupby("session")
    }
    assert not flag_sessions(responses, expected=drawn)["incomplete"].any()
    drawn["s2"] |= {"collide_2"}
    flags = flag_sessions(responses, expected=drawn).set_index("session")
    assert list(flags.index[flags["incomplete"]]) == ["s2"]
    by_scenario = {"collide": frozenset({"collide_0"}), "support": frozenset({"support_0"})}
    both = expected_by_session(responses, by_scenario)
    assert both["s0"] == {"collide_0", "support_0"}


def test_two_scenarios_without_blocks_are_still_an_error() -> None:
    rows = session_rows(1)
    with pytest.raises(BadInputError, match="two scenarios"):
        clean(table([{**row, "block": None} for row in rows]))
    with pytest.raises(BadInputError, match="two scenarios"):
        clean(table([{**row, "block": 0} for row in rows]))
    without = table(rows).drop(columns="block")
    with pytest.raises(BadInputError, match="two scenarios"):
        clean(without)
    other = sessions_of(range(1, 2)).assign(scenario="collide drop")
    with pytest.raises(BadInputError, match="missing from the sessions table"):
        clean(table(rows), other)


def test_all_analyses_take_sessions_of_several_blocks(tmp_path: Path) -> None:
    people = range(12)
    rows = [row for person in people for row in session_rows(person)]
    ages = sessions_of(people).assign(age=[20 + person for person in people])
    results = analyse_people(clean(table(rows), ages))
    by_scenario = results.tables["by_scenario"].set_index("scenario")
    assert by_scenario.loc["collide", "people"] == by_scenario.loc["support", "people"] == 12
    background = results.tables["background_tests"].set_index("question")
    assert background.loc["age", "sessions"] == 12, "a session counts once"
    pd.DataFrame(rows).to_csv(tmp_path / "trials.csv", index=False)
    sessions_of(people).to_csv(tmp_path / "sessions.csv", index=False)
    checked, _ = check_responses([tmp_path / "trials.csv"], tmp_path / "sessions.csv")
    assert checked.errors == 0 and checked.people == {"collide": 12, "support": 12}


def test_sessions_are_drawn_with_all_their_scenarios() -> None:
    """People who are good in one scenario are good in the other: their mean varies more."""
    rows = []
    for person in range(40):
        for row in session_rows(person):
            right = person % 2 == 0
            label = bool(row["label"])
            rows.append({**row, "response": "yes" if label == right else "no"})
    test = clean(table(rows)).test
    mean = accuracy_by_scenario(test).set_index("scenario").loc["mean"]
    assert mean["people"] == 40 and mean["accuracy"] == 0.5
    # The mean of 40 people who are right always or never has a standard error of 0.079.
    assert 0.13 < mean["accuracy_high"] - 0.5 < 0.18
    apart = test.assign(session=test["session"] + test["scenario"])
    independent = accuracy_by_scenario(apart).set_index("scenario").loc["mean"]
    assert independent["people"] == 80
    assert 0.09 < independent["accuracy_high"] - 0.5 < 0.13
