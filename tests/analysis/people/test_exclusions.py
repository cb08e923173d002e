"""Exclusions: rules on sessions made to break them, completeness, what the server found."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from itertools import groupby
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from physion.analysis.intervals import Bootstrap
from physion.analysis.people.exclusions import (
    NOT_EXPECTED,
    OFFICIAL_CODE,
    PREREGISTERED,
    RULE_SETS,
    RULES,
    ExclusionRules,
    completeness_warnings,
    count_flags,
    drop_unexpected,
    find_expected,
    flag_sessions,
    large_exclusions,
    longest_alternation,
    longest_streak,
    read_expected,
    streak_limit,
    with_and_without,
)
from physion.analysis.people.measures import accuracy_by_scenario
from physion.analysis.people.responses import DROPPED_COLUMNS, VOID, Responses, missing_times
from physion.analysis.people.results import analyse_people, rules_called
from physion.core.errors import BadInputError
from support.simulated_people import as_responses, simulate_study, study

answers = st.lists(st.booleans(), max_size=60)


def flagged_by(flags: pd.DataFrame, rule: str) -> list[str]:
    return flags.loc[flags[rule], "session"].tolist()


# --- measures --------------------------------------------------------------------------------


@settings(deadline=None)
@given(answers)
def test_streaks_are_the_longest_groups(yes: list[bool]) -> None:
    expected = max((len(list(group)) for _, group in groupby(yes)), default=0)
    assert longest_streak(yes) == expected


@settings(deadline=None)
@given(answers)
def test_alternation_is_the_streak_of_every_second_answer_turned(yes: list[bool]) -> None:
    turned = [answer ^ bool(place % 2) for place, answer in enumerate(yes)]
    assert longest_alternation(yes) == longest_streak(turned)
    text = "".join("YN"[not answer] for answer in yes)
    for begins in (True, False):
        pattern = ("YN" if begins else "NY") * 30
        expected = max(n for n in range(61) if pattern[:n] in text)
        assert longest_alternation(yes, begins) == expected


def exact_share_up_to(longest: int, tosses: int) -> float:
    """The chance that no run of ``tosses`` fair answers is longer, by recursion."""

    @cache
    def sequences(n: int) -> int:
        """Sequences of n answers that begin anew, with no run over the limit."""
        return 1 if n == 0 else sum(sequences(n - k) for k in range(1, min(longest, n) + 1))

    return 2 * sequences(tosses) / 2**tosses


def test_the_limit_of_a_streak_depends_on_the_number_of_trials() -> None:
    # 12 of 150 trials was preregistered.
    assert [streak_limit(n) for n in (150, 60, 20, 1, 0)] == [12, 10, 9, 1, 0]
    for trials, percentile in ((150, 97.5), (60, 97.5), (20, 90.0), (7, 50.0)):
        limit = streak_limit(trials, percentile)
        below, above = (100 * exact_share_up_to(k, trials) for k in (limit - 1, limit))
        assert below < percentile <= above
    every = [[bool(number >> k & 1) for k in range(10)] for number in range(2**10)]
    longest = np.array([longest_streak(answers) for answers in every])
    limit = streak_limit(10, 90)
    assert np.mean(longest <= limit) >= 0.9 > np.mean(longest <= limit - 1)


def test_a_session_of_60_trials_is_flagged_from_a_streak_of_11_on() -> None:
    rest = some_answers(3, 46)
    sessions = {
        f"run{n}": [*[not rest[0]] * n, *rest, *[not rest[-1], rest[-1]] * 3][:60] for n in (10, 11)
    }
    found = with_answers(sessions, [True] * 60)
    for rules in RULE_SETS.values():
        flags = flag_sessions(found, rules)
        assert flags["longest_streak"].tolist() == [10, 11]
        assert flagged_by(flags, "streak") == ["run11"]


# --- rules --------------------------------------------------------------------------------


def with_answers(responses_of: dict[str, list[bool]], label: list[bool]) -> Responses:
    """One scenario; the answers of each session in their order."""
    rows = [
        {"participant": name.split("/")[0], "session": name, "scenario": "drop", "phase": "test",
         "stimulus": f"s{k}", "trial": k, "response": "yes" if yes else "no", "label": label[k],
         "rt_ms": 1000.0, "simulated": False}
        for name, given in responses_of.items()
        for k, yes in enumerate(given)
    ]  # fmt: skip
    return as_responses(pd.DataFrame(rows))


def some_answers(seed: int, n: int = 40) -> list[bool]:
    """Neither long streaks nor long alternations."""
    generator = np.random.default_rng(seed)
    while True:
        found = [bool(x) for x in generator.random(n) < 0.5]
        if longest_streak(found) < 9 and longest_alternation(found) < 9:
            return found


def test_streaks_from_13_and_alternations_from_24_on_are_flagged() -> None:
    base, pause = [True, True, False], [False, False, True, True, False, False, True]
    sessions = {
        "streak12": [*pause, *[False], *[True] * 12, *[False], *pause, *pause, *base, *[False] * 2],
        "streak13": [*pause, *[False], *[True] * 13, *[False], *pause, *pause, *base, *[False]],
        "turns23": [True, *[True, False] * 11, True, True, *pause, *pause, *[False]],
        "turns24": [True, *[True, False] * 12, False, *pause, *pause],
    }
    n = 150
    found = with_answers(
        {name: [*given, *pause * 20][:n] for name, given in sessions.items()}, [True] * n
    )
    flags = flag_sessions(found).set_index("session", drop=False)
    measures = flags[["longest_streak", "longest_alternation"]]
    assert measures.loc["streak12", "longest_streak"] == 12
    assert measures.loc["streak13", "longest_streak"] == 13
    assert measures.loc["turns23", "longest_alternation"] == 23
    assert measures.loc["turns24", "longest_alternation"] == 24
    assert flagged_by(flags, "streak") == ["streak13"]
    assert flagged_by(flags, "alternation") == ["turns24"]
    official = flag_sessions(found, OFFICIAL_CODE)
    assert set(flagged_by(official, "alternation")) == {"turns23", "turns24"}


def test_the_released_alternation_counts_one_phase_only() -> None:
    first = [False, True, *[True, False] * 10, False, False, True]
    other = [True, False, *[False, True] * 10, True, True, False]
    label = [True] * 25
    # The scenario's first answer sets the phase: no. Twenty answers from yes on hold 19 from no on.
    found = with_answers({"a": first, "b": other}, label)
    assert flagged_by(flag_sessions(found, OFFICIAL_CODE), "alternation") == ["b"]
    either = replace(OFFICIAL_CODE, alternation_phase=None)
    assert flagged_by(flag_sessions(found, either), "alternation") == ["a", "b"]


def test_practice_accuracy_and_response_time_rules() -> None:
    trials, sessions = simulate_study(people=40, stimuli=60, scenarios=("roll",), ability_sd=0.1)
    wrong = trials["session"] == "roll-s000"
    practice = trials["phase"] == "familiarization"
    trials = trials.drop(columns="correct")
    flip = wrong & practice & (trials["trial"] >= 3)
    trials.loc[flip, "response"] = np.where(trials.loc[flip, "label"], "no", "yes")
    flip = (trials["session"] == "roll-s001") & practice & (trials["trial"] >= 4)
    trials.loc[flip, "response"] = np.where(trials.loc[flip, "label"], "no", "yes")
    poor = (trials["session"] == "roll-s002") & ~practice
    trials.loc[poor, "response"] = np.where(trials.loc[poor, "label"], "no", "yes")
    slow = (trials["session"] == "roll-s003") & ~practice
    trials.loc[slow, "rt_ms"] *= 3
    rules = replace(PREREGISTERED, streak_percentile=None)
    flags = flag_sessions(as_responses(trials, sessions), rules)
    assert flagged_by(flags, "familiarization") == ["roll-s000"]  # 3 of 10; 4 of 10 is enough
    assert flagged_by(flags, "low_accuracy") == ["roll-s002"]
    assert flagged_by(flags, "slow") == ["roll-s003"]
    assert not flags[["streak", "alternation", "incomplete", "repeated"]].any(axis=None)
    whole = flags["accuracy"]
    limit = whole.median() - 3 * whole.std(ddof=1)
    assert flags.set_index("session")["accuracy"]["roll-s002"] < limit
    table = count_flags(flags).set_index("rule")["sessions"]
    assert table["flagged"] == 3 and table["kept"] == 37 and table["all"] == 40


def test_centre_and_spread_come_from_complete_sessions_only() -> None:
    """Four broken-off sessions, slow and wrong, would hide a poor one and a slow one."""
    rights = {f"c{k:02d}": 36 - 2 * (k % 2) for k in range(16)} | {"poor": 28, "slow": 35}
    rights |= {f"broken{k}": 5 for k in range(4)}
    sessions = {name: [True] * n + [False] * (40 - n) for name, n in rights.items()}
    sessions = {name: given[: 39 if "broken" in name else 40] for name, given in sessions.items()}
    found = with_answers(sessions, [True] * 40)
    log_rt = {name: 7.0 + 0.1 * (k % 2) for k, name in enumerate(rights)}
    log_rt |= {"slow": 7.4} | {f"broken{k}": 9.0 for k in range(4)}
    found = replace(found, trials=found.trials.assign(log_rt=found.trials["session"].map(log_rt)))
    complete = [name for name in rights if "broken" not in name]
    accuracy = pd.Series({name: np.mean(given) for name, given in sessions.items()})
    times = pd.Series(log_rt)
    only = replace(PREREGISTERED, name="preregistered-only", server=False)
    assert list(RULE_SETS.values()) == [PREREGISTERED, only, OFFICIAL_CODE]
    for rules, centre, ddof in ((PREREGISTERED, np.median, 1), (OFFICIAL_CODE, np.mean, 0)):
        flags = flag_sessions(found, rules).set_index("session")
        assert set(flags.index[flags["incomplete"]]) == {f"broken{k}" for k in range(4)}
        whole = accuracy[complete].to_numpy()
        limit = centre(whole) - 3 * np.std(whole, ddof=ddof)
        assert flags["low_accuracy"].to_dict() == (accuracy < limit).to_dict()
        assert flags.loc["poor", "low_accuracy"] and not flags.loc["slow", "low_accuracy"]
        whole = times[complete].to_numpy()
        limit = np.median(whole) + 3 * np.std(whole, ddof=ddof)
        assert flags["slow"].to_dict() == (times > limit).to_dict()
        assert flags.loc["slow", "slow"] and not flags.loc["poor", "slow"]


def test_incomplete_and_repeated_sessions_are_flagged() -> None:
    label = [True] * 40
    found = with_answers(
        {
            "ann/1": some_answers(1)[:30],
            "ann/2": some_answers(2),
            "ann/3": some_answers(3),
            "bob/1": some_answers(4),
            "cid/1": some_answers(5)[:39],
        },
        label,
    )
    flags = flag_sessions(found)
    assert flagged_by(flags, "incomplete") == ["ann/1", "cid/1"]
    assert flagged_by(flags, "repeated") == ["ann/1", "ann/3"]  # the first complete one counts
    assert (flags["familiarization_trials"] == 0).all() and not flags["familiarization"].any()
    assert "familiarization not assessed" in set(count_flags(flags)["rule"])
    longer = flag_sessions(found, expected={"drop": frozenset(f"s{k}" for k in range(41))})
    assert longer["incomplete"].all()


def test_rules_can_be_turned_off_and_missing_times_do_not_flag() -> None:
    nothing = ExclusionRules("nothing", None, None, None, None, None, "median", None)
    found = with_answers({"a": [True] * 40, "b": [True, False] * 20}, [True] * 40)
    assert not flag_sessions(found, nothing)["flagged"].any()
    assert flag_sessions(found)["flagged"].all()
    blind = replace(found, trials=found.trials.assign(log_rt=np.nan))
    flags = flag_sessions(blind)
    assert not flags["slow"].any() and (flags["no_log_rt"] == 40).all()
    assert count_flags(flags).set_index("rule")["sessions"]["slow not assessed"] == 2
    assert "slow not assessed" not in set(count_flags(flag_sessions(found))["rule"])


def test_missing_response_times_are_counted() -> None:
    found = with_answers({"a": [True, False] * 3, "b": [True, False] * 3}, [True] * 6)
    assert missing_times(found).empty
    late = found.trials["session"].eq("a") & (found.trials["trial"] < 2)
    some = replace(found, trials=found.trials.assign(log_rt=found.trials["log_rt"].mask(late)))
    table = missing_times(some)
    assert tuple(table.columns) == DROPPED_COLUMNS
    assert table[["scenario", "sessions", "rows"]].to_numpy().tolist() == [["drop", 1, 2]]
    assert table["rows"].sum() == flag_sessions(some)["no_log_rt"].sum()


def test_only_practice_is_refused() -> None:
    trials, sessions = simulate_study(people=3, stimuli=4, scenarios=("roll",))
    practice = trials[trials["phase"] == "familiarization"]
    with pytest.raises(BadInputError, match="no test answer"):
        flag_sessions(as_responses(practice, sessions))


# --- with and without, and the effect -----------------------------------------------------------


def test_analyses_are_done_with_and_without_the_flagged() -> None:
    responses = study(people=30, stimuli=40, scenarios=("drop",), seed=4)
    flags = flag_sessions(responses)
    flags["streak"] = flags["flagged"] = flags.index < 5
    both = with_and_without(responses, flags, lambda kept: accuracy_by_scenario(kept.test))
    people = both[both["scenario"] == "drop"].set_index("sessions")["people"]
    assert people["unflagged"] == 25 and people["complete"] == 30
    with pytest.raises(BadInputError, match="no session is unflagged"):
        with_and_without(responses, flags.assign(flagged=True), lambda kept: kept.test)


# --- completeness --------------------------------------------------------------------------------

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
    assert "give the study's list (--expected)" in warning and "9 sessions" in warning
    (warning,) = completeness_warnings(found, {"drape": DROP})
    assert "give" not in warning and "names none of its stimuli" in warning, "it was given"


def test_a_session_without_answers_is_incomplete_whatever_was_expected() -> None:
    found = study(people=4, stimuli=6, scenarios=("drop",))
    silent = found.trials["session"].eq("drop-s001") & found.trials["phase"].eq("test")
    flags = flag_sessions(replace(found, trials=found.trials[~silent].reset_index(drop=True)))
    assert flags.loc[flags["incomplete"], "session"].tolist() == ["drop-s001"]


def test_a_rule_that_leaves_out_more_than_a_third_is_warned_of() -> None:
    found = study(people=12, stimuli=10, scenarios=("drop", "roll"), slow_by_error=0.0)
    calm = flag_sessions(found).assign(**dict.fromkeys(RULES, False))
    drop = calm[calm["scenario"] == "drop"].index
    assert large_exclusions(calm.assign(slow=calm.index.isin(drop[:4]))) == []
    (words,) = large_exclusions(calm.assign(slow=calm.index.isin(drop[:5])))
    assert "'slow' leaves out 5 of 12 sessions of drop" in words
    # Sessions that never answered do not count.
    silent = calm.assign(trials=np.where(calm.index.isin(drop[:6]), 0, calm["trials"]))
    silent["incomplete"] = silent["trials"].eq(0)
    assert large_exclusions(silent) == []
    silent.loc[drop[6:9], "incomplete"] = True
    assert "'incomplete' leaves out 3 of 6" in large_exclusions(silent)[0]
    short = found.trials["session"].isin(calm.loc[drop[:5], "session"])
    short &= found.trials["stimulus"].eq("drop_003")
    cut = found.trials[~short].reset_index(drop=True)
    warned = analyse_people(replace(found, trials=cut), bootstrap=QUICK).warnings
    assert any("'incomplete' leaves out 5 of 12" in warning for warning in warned)


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


# --- server --------------------------------------------------------------------------------

SESSIONS = pd.DataFrame({
    "session": ["a", "b", "c"], "implausible": ["", "no media, short", ""],
    "replayed": pd.array([0, None, 2], dtype="Int64"),
})  # fmt: skip
TRIALS = pd.DataFrame({
    "session": ["a", "a", "b"], "scenario": "drop", "void": ["", "hidden", ""],
})  # fmt: skip
NOTHING = pd.DataFrame(columns=["step", "scenario", "reason", "sessions", "rows"])


def test_only_preregistered_rules_leave_out_nothing_that_the_server_found() -> None:
    trials, sessions = simulate_study(people=5, stimuli=8, scenarios=("drop",))
    sessions["implausible"] = ["no media, short", "", "", "", ""]
    sessions["replayed"] = pd.array([0, None, 2, 0, 0], dtype="Int64")
    sessions["failed_checks"] = ["", "attention", "", "", ""]
    responses = as_responses(trials, sessions)
    both = {rules.name: flag_sessions(responses, rules) for rules in RULE_SETS.values()}
    strict, only = both["preregistered"], both["preregistered-only"]
    for place, rule in enumerate(("implausible", "failed_checks", "replayed")):
        assert list(strict.index[strict[rule]]) == [place]
    assert not flag_sessions(as_responses(trials), PREREGISTERED)["implausible"].any()
    assert not only[["implausible", "replayed", "failed_checks"]].to_numpy().any()
    others = [rule for rule in RULES if rule not in ("implausible", "replayed", "failed_checks")]
    pd.testing.assert_frame_equal(strict[others], only[others])


def test_an_exported_study_brings_its_rules(tmp_path: Path) -> None:
    responses = [tmp_path / "trials.csv"]
    assert rules_called(None, responses).name == "preregistered"
    states = [
        {"settings": {"exclusions": name}} for name in ("official-code", "preregistered-only")
    ]
    (tmp_path / "study.json").write_text(json.dumps({"states": states}))
    assert rules_called(None, responses).name == "preregistered-only"
    assert rules_called("official-code", responses).name == "official-code"
    (tmp_path / "study.json").write_text('{"states": [{}]}')
    assert rules_called(None, responses).name == "preregistered"


def test_answers_after_an_interrupted_movie_are_dropped_and_counted() -> None:
    kept = Responses(TRIALS, SESSIONS, NOTHING).drop_void()
    assert list(kept.trials["void"]) == ["", ""]
    assert kept.dropped[["reason", "sessions", "rows"]].to_numpy().tolist() == [[VOID, 1, 1]]
    old = Responses(TRIALS.drop(columns="void"), SESSIONS, NOTHING)
    assert len(old.drop_void().trials) == 3
