"""Which sessions are complete, and rules that leave out too many of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

from physion.analysis import Bootstrap
from physion.analysis.people.exclusions import (
    NOT_EXPECTED,
    RULES,
    check_excluded,
    completeness_warnings,
    drop_unexpected,
    find_expected,
    flag_sessions,
    read_expected,
)
from physion.analysis.people.responses import Responses
from physion.analysis.people.results import analyse_people
from physion.core.errors import BadInputError, ExclusionError, UnknownNameError
from support.simulated_people import as_responses, simulate_study, study

QUICK = Bootstrap(resamples=20)
DROP = frozenset(f"drop_{k:03d}" for k in range(20))


def with_stray(stimulus: str = "drop_elsewhere") -> Responses:
    """Return 14 complete sessions; the first one also answered a stimulus that nobody else saw."""
    trials, sessions = simulate_study(people=14, stimuli=20, scenarios=("drop",))
    last = trials[(trials["session"] == "drop-s000") & (trials["phase"] == "test")].tail(1)
    stray = last.assign(stimulus=stimulus, trial=20)
    return as_responses(pd.concat([trials, stray], ignore_index=True), sessions)


def test_one_answer_to_an_unknown_stimulus_makes_no_session_incomplete() -> None:
    flags = flag_sessions(with_stray())
    assert set(flags["expected"]) == {20} and not flags["missing"].any()
    assert not flags["incomplete"].any()
    results = analyse_people(with_stray(), bootstrap=QUICK)
    (people,) = results.tables["by_scenario"].loc[lambda rows: rows["scenario"] == "drop", "people"]
    assert people == 14 - int(results.tables["flags"]["flagged"].sum()) > 9
    (warning,) = results.warnings
    assert "drop_elsewhere" in warning and "fewer than half" in warning and ": 1, " in warning


def test_the_list_of_the_study_decides() -> None:
    found = with_stray()
    short = found.trials["session"].eq("drop-s000") & found.trials["stimulus"].eq("drop_007")
    swapped = replace(found, trials=found.trials[~short].reset_index(drop=True))
    # Twenty answers, but one of them is not to a stimulus of the list.
    flags = flag_sessions(swapped, expected={"drop": DROP}).set_index("session")
    assert flags.loc["drop-s000", ["trials", "expected", "missing"]].tolist() == [20, 20, 1]
    assert list(flags.index[flags["incomplete"]]) == ["drop-s000"]
    by_session = {"drop-s000": DROP - {"drop_007"}}
    assert not flag_sessions(swapped, expected=by_session)["incomplete"].any()
    kept = drop_unexpected(swapped, {"drop": DROP})
    assert set(kept.test["stimulus"]) == DROP
    assert kept.dropped[["reason", "rows"]].to_numpy().tolist() == [[NOT_EXPECTED, 1]]
    assert (kept.trials["phase"] == "familiarization").sum() == 140
    (warning,) = completeness_warnings(swapped, {"drop": DROP})
    assert "study's list are left out: 1, the first to 'drop_elsewhere'" in warning
    results = analyse_people(found, expected={"drop": DROP}, bootstrap=QUICK)
    assert "drop_elsewhere" not in set(results.tables["by_stimulus"]["stimulus"])
    assert NOT_EXPECTED in set(results.tables["left_out"]["reason"])


def test_sessions_with_stimuli_of_their_own_are_not_judged_without_a_list() -> None:
    trials, sessions = simulate_study(people=9, stimuli=30, scenarios=("drop",))
    person = trials["session"].str[-3:].astype(int)
    third = trials["stimulus"].str[-3:].str.isdigit() & (trials["phase"] == "test")
    number = trials["stimulus"].where(third, "0").str.extract(r"(\d+)$")[0].astype(int)
    found = as_responses(trials[~third | (number % 3 == person % 3)], sessions)
    flags = flag_sessions(found)
    assert (flags["trials"] == 10).all() and (flags["expected"] == 0).all()
    assert not flags["incomplete"].any()
    (warning,) = completeness_warnings(found, None)
    assert "--expected" in warning and "9 sessions" in warning
    seen = found.test.groupby("session")["stimulus"].agg(frozenset).to_dict()
    assert completeness_warnings(found, seen) == []
    seen["drop-s004"] |= {"drop_031"}
    flags = flag_sessions(found, expected=seen)
    assert flags.loc[flags["incomplete"], "session"].tolist() == ["drop-s004"]


def test_a_session_without_answers_is_incomplete_whatever_was_expected() -> None:
    found = study(people=4, stimuli=6, scenarios=("drop",))
    silent = found.trials["session"].eq("drop-s001") & found.trials["phase"].eq("test")
    flags = flag_sessions(replace(found, trials=found.trials[~silent].reset_index(drop=True)))
    assert flags.loc[flags["incomplete"], "session"].tolist() == ["drop-s001"]


def test_a_rule_that_leaves_out_more_than_a_third_stops() -> None:
    found = study(people=12, stimuli=10, scenarios=("drop", "roll"), slow_by_error=0.0)
    calm = flag_sessions(found).assign(**dict.fromkeys(RULES, False))
    drop = calm[calm["scenario"] == "drop"].index
    check_excluded(calm.assign(slow=calm.index.isin(drop[:4])))
    many = calm.assign(slow=calm.index.isin(drop[:5]))
    with pytest.raises(ExclusionError, match="'slow' leaves out 5 of 12 sessions of drop") as error:
        check_excluded(many)
    assert (error.value.rule, error.value.scenario) == ("slow", "drop")
    assert "--accept-rules slow" in str(error.value) and isinstance(error.value, BadInputError)
    check_excluded(many, ["slow"])
    with pytest.raises(ExclusionError):
        check_excluded(many, ["streak"])
    with pytest.raises(UnknownNameError, match="slow"):
        check_excluded(calm, ["slaw"])


def test_analysis_stops_unless_confirmed() -> None:
    found = study(people=6, stimuli=10, scenarios=("drop",))
    half = found.test.loc[found.test["session"].isin(["drop-s000", "drop-s001", "drop-s002"])]
    cut = found.trials.drop(index=half.index[half["stimulus"] == "drop_003"]).reset_index(drop=True)
    some = replace(found, trials=cut)
    with pytest.raises(ExclusionError, match=r"'incomplete' leaves out 3 of 6 .*--expected"):
        analyse_people(some, bootstrap=QUICK)
    listed = {"drop": frozenset(found.test["stimulus"])}
    with pytest.raises(ExclusionError, match="'incomplete' leaves out 3 of 6") as error:
        analyse_people(some, expected=listed, bootstrap=QUICK)
    assert "--expected" not in str(error.value), "the list was given"
    results = analyse_people(some, accept_rules=["incomplete"], bootstrap=QUICK)
    assert results.tables["flags"]["incomplete"].sum() == 3


def test_sessions_that_never_answered_do_not_count_in_the_third() -> None:
    found = study(people=12, stimuli=10, scenarios=("drop",), slow_by_error=0.0)
    calm = flag_sessions(found).assign(**dict.fromkeys(RULES, False))
    silent = calm.index[:6]
    calm.loc[silent, ["trials", "incomplete"]] = [0, True]
    check_excluded(calm)
    calm.loc[calm.index[6:9], "incomplete"] = True
    with pytest.raises(ExclusionError, match="'incomplete' leaves out 3 of 6"):
        check_excluded(calm)


def test_the_list_is_found_next_to_the_responses(tmp_path: Path) -> None:
    responses = [tmp_path / "trials.csv"]
    assert find_expected(responses) is None
    (tmp_path / "expected.csv").write_text(
        "stimulus,scenario\ndrop_001,Drop\ndrop_002_img.mp4,drop\nx,towers\n"
    )
    found = find_expected(responses)
    assert found is not None
    assert read_expected(found) == {
        "drop": frozenset({"drop_001", "drop_002"}),
        "support": frozenset({"x"}),
    }
