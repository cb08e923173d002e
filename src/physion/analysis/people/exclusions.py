"""Exclusion rules: which sessions are flagged, by which rule, and with which effect.

Rules flag sessions and do not drop them: `flag_sessions` returns one row per session and one
column per rule, so that analyses can be done with and without flagged sessions, as preregistered.
Rule sets are values: `PREREGISTERED` follows the text of the preregistration, `OFFICIAL_CODE` the
released code, which differs from it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.people.responses import Responses
from physion.analysis.tables import in_order
from physion.core.errors import BadInputError
from physion.core.names import OFFICIAL_SCENARIOS, canonical_name
from physion.core.tables import read_table

# Completeness of sessions: the stimuli that a session must have answered, and answers to others.
#
# The study's list of test stimuli decides (`read_expected`). Without one, a session must have the
# stimuli that at least half of the scenario's sessions answered, so that one answer to an unknown
# stimulus does not make every other session incomplete.

Expected = Mapping[str, frozenset[str]]
"""Canonical names of the test stimuli by scenario."""

EXPECTED_FILE = "expected.csv"
"""File with the study's list of stimuli, in the folder of the exported responses."""

NOT_EXPECTED = "stimulus is not on the study's list"


def read_expected(path: Path) -> dict[str, frozenset[str]]:
    """Read the stimuli that a session must have from a list of them (CSV or parquet).

    Columns: ``stimulus`` and ``scenario``. Raises `BadInputError`.
    """
    table = read_table(path, ("stimulus", "scenario"))
    names = table["stimulus"].astype(str).map(canonical_name)
    lower = table["scenario"].astype(str).str.strip().str.lower()
    whose = lower.replace(OFFICIAL_SCENARIOS)
    return {str(key): frozenset(group) for key, group in names.groupby(whose)}


def find_expected(responses: Sequence[Path]) -> Path | None:
    """Return the list `EXPECTED_FILE` next to the responses of an export, or None."""
    paths = [file.parent / EXPECTED_FILE for file in responses]
    return next((path for path in paths if path.is_file()), None)


def check_expected(responses: Responses, expected: Expected | None) -> None:
    """Raise `BadInputError` for a list that names none of these scenarios."""
    if expected is not None and not set(responses.sessions["scenario"]) & set(expected):
        raise BadInputError(
            f"the list of expected stimuli names {next(iter(expected), 'nothing')!r}, which is "
            "not a scenario of the responses"
        )


def stimuli_of_most(test: pd.DataFrame) -> dict[str, frozenset[str]]:
    """Return by scenario the stimuli that at least half of its sessions with answers answered.

    ``test``: rows of the test phase. A scenario whose sessions saw different stimuli has none.
    """
    sessions = test.groupby("scenario")["session"].nunique()
    answered = test.groupby(["scenario", "stimulus"])["session"].nunique().reset_index()
    of_most = answered[2 * answered["session"] >= answered["scenario"].map(sessions)]
    found = {str(name): frozenset(rows["stimulus"]) for name, rows in of_most.groupby("scenario")}
    return {str(name): found.get(str(name), frozenset()) for name in sessions.index}


def expected_by_session(
    responses: Responses, expected: Expected | None
) -> dict[str, frozenset[str]]:
    """Return the stimuli that each session must have answered.

    The list of its scenario, else `stimuli_of_most`; none for a scenario without either.
    """
    of_scenario = {**stimuli_of_most(responses.test), **(expected or {})}
    pairs = responses.sessions[["session", "scenario"]].to_numpy()
    return {str(session): of_scenario.get(name, frozenset()) for session, name in pairs}


def drop_unexpected(responses: Responses, expected: Expected | None) -> Responses:
    """Return the responses without test answers to stimuli that are not on the study's list.

    Sessions without a list keep all answers. Flag sessions first: rules about the sequence of
    answers need all of them.
    """
    if expected is None:
        return responses
    in_list = responses.trials["session"].isin(_listed(responses, expected))
    return responses.drop_rows(
        _not_expected(responses, expected) & in_list, "stimuli", NOT_EXPECTED
    )


def completeness_warnings(responses: Responses, expected: Expected | None) -> list[str]:
    """Return what users should know about completeness, at most one sentence a scenario.

    They are about answers to stimuli that are not expected, and about scenarios whose sessions
    cannot be judged because they saw different stimuli.
    """
    of_session = expected_by_session(responses, expected)
    listed = _listed(responses, expected or {})
    others = responses.trials[_not_expected(responses, expected)]
    found = []
    for scenario in in_order(responses.test["scenario"]):
        sessions = set(responses.test.loc[responses.test["scenario"] == scenario, "session"])
        rows = others[others["scenario"] == scenario]
        if not any(of_session[session] for session in sessions):
            advice = (
                "the study's list (--expected) names none of its stimuli"
                if expected is not None
                else "give the study's list (--expected)"
            )
            found.append(
                f"{scenario}: no stimulus was answered by half of the {len(sessions)} sessions, so "
                f"no session with answers counts as incomplete; {advice}"
            )
        elif len(rows):
            which, consequence = (
                ("are not on the study's list", "are left out")
                if sessions & listed
                else ("fewer than half of the sessions answered", "do not count for completeness")
            )
            found.append(
                f"{scenario}: answers to stimuli that {which} {consequence}: {len(rows)}, the "
                f"first to {rows['stimulus'].iloc[0]!r}"
            )
    return found


def _listed(responses: Responses, expected: Expected) -> set[str]:
    """Return the sessions for whose scenario the list names stimuli."""
    rows = responses.sessions
    return set(rows.loc[rows["scenario"].isin(set(expected)), "session"])


def _not_expected(responses: Responses, expected: Expected | None) -> pd.Series:
    """Return which rows of the trials are test answers to a stimulus that is not expected."""
    of_session = expected_by_session(responses, expected)
    trials = responses.trials
    pairs = zip(trials["session"], trials["stimulus"], strict=True)
    found = [stimulus not in of_session[session] for session, stimulus in pairs]
    return pd.Series(found, index=trials.index, dtype=bool) & (trials["phase"] == "test")


# Measures of a session for the exclusion rules: streaks, alternations, accuracy, response
# times.


def longest_streak(yes: npt.ArrayLike) -> int:
    """Return the length of the longest run of one answer; 0 without answers."""
    answers = np.asarray(yes, dtype=bool)
    return _longest_run(answers[1:] == answers[:-1]) + 1 if len(answers) else 0


def longest_alternation(yes: npt.ArrayLike, begins_with: bool | None = None) -> int:
    """Return the length of the longest run of answers in which each differs from the one before.

    ``begins_with``: count only from the first answer of this value on, in each run.
    """
    answers = np.asarray(yes, dtype=bool)
    if not len(answers):
        return 0
    if begins_with is None:
        return _longest_run(answers[1:] != answers[:-1]) + 1
    breaks = np.flatnonzero(answers[1:] == answers[:-1]) + 1
    stretches = np.split(answers, breaks)
    return max(len(part) - int(part[0] != begins_with) for part in stretches)


def _longest_run(same: npt.NDArray[np.bool_]) -> int:
    """Return the length of the longest run of True."""
    ends = np.flatnonzero(np.concatenate(([True], ~same, [True])))
    return int(np.max(np.diff(ends))) - 1


def session_measures(responses: Responses, expected: Expected | None = None) -> pd.DataFrame:
    """Return the measures for the rules, one row per session, in order of ``sessions``.

    ``expected``: the test stimuli by scenario; by default
    those that at least half of the scenario's sessions answered (`completeness`). Columns:
    ``session``, ``participant``, ``scenario``, ``expected`` (number of stimuli), ``missing``
    (stimuli without an answer), ``trials``, ``accuracy``, ``yes``, ``mean_log_rt``,
    ``median_log_rt``, ``no_log_rt`` (trials without a response time above 0), ``longest_streak``,
    ``longest_alternation``, ``longest_alternation_from_first``, ``familiarization_trials``,
    ``familiarization_correct``. Raises `BadInputError` if no session has a test answer.
    """
    test = responses.test
    if test.empty:
        raise BadInputError(
            f"{len(responses.sessions)} session(s) hold only practice and no test answer: "
            "give responses with test trials"
        )
    wanted = expected_by_session(responses, expected)
    by_session = {
        str(session): rows.sort_values("trial", kind="stable")
        for session, rows in test.groupby("session", sort=False)
    }
    begins: dict[str, bool] = {}
    for session, scenario in responses.sessions[["session", "scenario"]].to_numpy():
        if session in by_session:
            begins.setdefault(scenario, bool(by_session[session]["yes"].iloc[0]))
    scenario_of = dict(responses.sessions[["session", "scenario"]].to_numpy())
    records = {
        session: _session_record(rows, begins[scenario_of[session]])
        for session, rows in by_session.items()
    }
    nothing = {"trials": 0, "longest_streak": 0, "longest_alternation": 0,
               "longest_alternation_from_first": 0, "no_log_rt": 0}  # fmt: skip
    keys = responses.sessions[["session", "participant", "scenario"]]
    measures = pd.DataFrame([records.get(session, nothing) for session in keys["session"]])
    measures = pd.concat([keys.reset_index(drop=True), measures], axis=1)
    answered = {name: frozenset(rows["stimulus"]) for name, rows in by_session.items()}
    names = measures["session"]
    measures["expected"] = [len(wanted[name]) for name in names]
    measures["missing"] = [len(wanted[name] - answered.get(name, frozenset())) for name in names]
    practice = responses.trials[responses.trials["phase"] == "familiarization"]
    counts = practice.groupby("session")["correct"].agg(["size", "sum"])
    counts = counts.reindex(measures["session"])
    measures["familiarization_trials"] = counts["size"].fillna(0).to_numpy(dtype=int)
    measures["familiarization_correct"] = counts["sum"].to_numpy(dtype=np.float64)
    return measures


def _session_record(rows: pd.DataFrame, begins: bool) -> dict[str, float]:
    yes, log_rt = rows["yes"].to_numpy(dtype=bool), rows["log_rt"].to_numpy(dtype=np.float64)
    known = log_rt[np.isfinite(log_rt)]
    return {
        "trials": len(rows),
        "accuracy": float(rows["correct"].mean()),
        "yes": float(yes.mean()),
        "mean_log_rt": float(np.mean(known)) if len(known) else np.nan,
        "median_log_rt": float(np.median(known)) if len(known) else np.nan,
        "no_log_rt": len(log_rt) - len(known),
        "longest_streak": longest_streak(yes),
        "longest_alternation": longest_alternation(yes),
        "longest_alternation_from_first": longest_alternation(yes, begins),
    }


RULES = (
    "streak",
    "alternation",
    "familiarization",
    "low_accuracy",
    "slow",
    "incomplete",
    "repeated",
    "implausible",
    "replayed",
    "failed_checks",
)
"""The rules, each a column of the table of flags. ``incomplete`` sessions lack answers;
``repeated`` ones are a participant's second and later sessions in a scenario. The last three are
not of the preregistration; the experiment's server finds them: sessions that no person can have
made, sessions with trials that were shown more often than the study allows, and sessions that
failed a check of the lab."""
FROM_SERVER = RULES[-3:]
"""Rules that are not of the preregistration."""


@dataclass(frozen=True)
class ExclusionRules:
    """Thresholds of the rules; None turns a rule off.

    - ``streak_percentile``: percentile of the longest run in as many fair coin tosses as a session
      has trials; a session with a longer run of one answer is flagged (`streak_limit`).
    - ``alternation``: answers in a row that alternate, from which on a session is flagged.
    - ``alternation_phase``: count only alternations that begin with ``first``, the first answer of
      the scenario's table, as the released code did; None: either.
    - ``familiarization_fraction``: fraction of right practice trials up to which it is flagged.
    - ``accuracy_sd``: standard deviations below the ``accuracy_centre`` of the scenario.
    - ``rt_sd``: standard deviations above the median of the participants' ``rt_summary`` of log
      response times.
    - ``ddof``: 1 divides the sum of squares by n - 1, 0 by n.
    - ``server``: flag also what the experiment's server found: implausible sessions, replayed
      trials, failed checks. None of this is in the preregistration.
    """

    name: str
    streak_percentile: float | None = 97.5
    alternation: int | None = 24
    alternation_phase: Literal["first"] | None = None
    familiarization_fraction: float | None = 0.3
    accuracy_sd: float | None = 3.0
    accuracy_centre: Literal["median", "mean"] = "median"
    rt_sd: float | None = 3.0
    rt_summary: Literal["mean", "median"] = "mean"
    ddof: int = 1
    server: bool = True


PREREGISTERED = ExclusionRules("preregistered")
"""As preregistered, and what the experiment's server found; the text of the preregistration leaves
open how a standard deviation is estimated: here with n - 1."""

PREREGISTERED_ONLY = ExclusionRules("preregistered-only", server=False)
"""Nothing but the rules of the preregistration."""

OFFICIAL_CODE = ExclusionRules(
    "official-code",
    alternation=20,
    alternation_phase="first",
    accuracy_centre="mean",
    rt_summary="median",
    ddof=0,
)
"""As in the released code, with the exact limit of a streak. The code's came from an unseeded
simulation of 150 tosses and changed between runs."""

RULE_SETS: Mapping[str, ExclusionRules] = {
    rules.name: rules for rules in (PREREGISTERED, PREREGISTERED_ONLY, OFFICIAL_CODE)
}


@cache
def streak_limit(trials: int, percentile: float = 97.5) -> int:
    """Return a percentile of the longest run of one answer in fair, independent answers.

    It is the smallest k for which at least ``percentile`` % of the 2^n sequences of n = ``trials``
    answers have no run longer than k: 12 for 150 answers, 10 for 60, 0 for none. A sequence is its
    first answer and the lengths of its runs, so that 2 c(n) of them have none longer than k, with
    c(0) = 1 and c(m) = c(m - 1) + ... + c(m - k).
    """
    for longest in range(1, trials + 1):
        counts = [1]
        for length in range(1, trials + 1):
            counts.append(sum(counts[max(0, length - longest) :]))
        if 100 * Fraction(2 * counts[trials], 2**trials) >= Fraction(percentile):
            return longest
    return 0


# --- rules: from the table of measures to a flag of each session --------------------------------


def flag_incomplete(measures: pd.DataFrame) -> pd.Series:
    """Flag an expected stimulus without an answer, or no test answer at all."""
    return (measures["missing"] > 0) | (measures["trials"] == 0)


def _by_thresholds(measures: pd.DataFrame, rules: ExclusionRules) -> dict[str, pd.Series]:
    """Return the flags of the rules of the preregistration; absent for a rule that is off."""
    flags = {}
    if rules.streak_percentile is not None:
        limits = [streak_limit(int(n), rules.streak_percentile) for n in measures["trials"]]
        flags["streak"] = measures["longest_streak"] > pd.Series(limits, index=measures.index)
    if rules.alternation is not None:
        which = "longest_alternation" + ("_from_first" if rules.alternation_phase else "")
        flags["alternation"] = measures[which] >= rules.alternation
    if rules.familiarization_fraction is not None:
        # Without recorded practice the fraction is NaN, and a session is not flagged.
        fraction = measures["familiarization_correct"] / measures["familiarization_trials"]
        limit = rules.familiarization_fraction + 1e-9  # so that 3 of 10 counts as 0.3
        flags["familiarization"] = fraction <= limit
    if rules.accuracy_sd is not None:
        base = _reference(measures, "accuracy", rules.accuracy_centre, rules.ddof)
        flags["low_accuracy"] = (
            measures["accuracy"] < base["centre"] - rules.accuracy_sd * base["sd"]
        )
    if rules.rt_sd is not None:
        column = f"{rules.rt_summary}_log_rt"
        base = _reference(measures, column, "median", rules.ddof)
        flags["slow"] = measures[column] > base["centre"] + rules.rt_sd * base["sd"]
    incomplete = flag_incomplete(measures)
    # Sessions count in the order in which they began; if none is complete, the first is kept.
    ordered = measures.assign(_incomplete=incomplete).sort_values("_incomplete", kind="stable")
    repeated = ordered.duplicated(["participant", "scenario"]).reindex(measures.index)
    return flags | {"incomplete": incomplete, "repeated": repeated}


def flag_from_server(responses: Responses, measures: pd.DataFrame, column: str) -> pd.Series:
    """Flag what the experiment's server found: a reason or a number above 0 in a column.

    Sessions without the column, such as in the original study, are not flagged.
    """
    if column not in responses.sessions:
        return pd.Series(False, index=measures.index)
    values = responses.sessions.set_index("session")[column]
    numeric = pd.api.types.is_numeric_dtype(values)
    found = values.fillna(0) > 0 if numeric else values.fillna("") != ""
    return measures["session"].map(found.astype(bool)).fillna(False).astype(bool)


def _reference(measures: pd.DataFrame, column: str, centre: str, ddof: int) -> pd.DataFrame:
    """Return centre and standard deviation of the complete sessions of each session's scenario."""
    complete = measures[~flag_incomplete(measures)]
    groups = complete.groupby("scenario")[column]
    table = pd.DataFrame({"centre": groups.agg(centre), "sd": groups.std(ddof=ddof)})
    result = table.reindex(measures["scenario"])
    return result.set_axis(measures.index)


# --- the table of flags ------------------------------------------------------------------------


def flag_sessions(
    responses: Responses,
    rules: ExclusionRules = PREREGISTERED,
    *,
    expected: Expected | None = None,
) -> pd.DataFrame:
    """Return one row per session: the measures, a bool for each of `RULES`, and ``flagged`` (any of
    them).

    ``expected``: the stimuli of a complete session, as in `session_measures`.

    Flag before stimuli are dropped: rules about sequences need all answers. Centres and standard
    deviations come from the scenario's complete sessions, whether another rule flags them or not.
    """
    measures = session_measures(responses, expected)
    found = _by_thresholds(measures, rules)
    if rules.server:
        found |= {name: flag_from_server(responses, measures, name) for name in FROM_SERVER}
    never = pd.Series(False, index=measures.index)
    table = measures.assign(**{name: found.get(name, never).astype(bool) for name in RULES})
    return table.assign(flagged=table[list(RULES)].any(axis=1))


def large_exclusions(flags: pd.DataFrame) -> list[str]:
    """Return a warning for each rule that flags more than a third of a scenario's sessions.

    Such a rule is more likely wrong for these data than the sessions are. Sessions without a single
    test answer (they consented and left) do not count: there is nothing to leave out of them.
    """
    answered = flags[flags["trials"] > 0].groupby("scenario", sort=False)
    return [
        f"the exclusion rule {rule!r} leaves out {int(rows[rule].sum())} of {len(rows)} sessions "
        f"of {scenario}: look at these sessions"
        for scenario, rows in answered
        for rule in RULES
        if 3 * rows[rule].sum() > len(rows)
    ]


def without_flagged(responses: Responses, flags: pd.DataFrame) -> Responses:
    """Return the responses of the sessions that no rule flags, for the main analysis.

    Raises `BadInputError` if none remains.
    """
    unflagged = set(flags.loc[~flags["flagged"], "session"])
    if not unflagged:
        raise BadInputError(f"all {len(flags)} sessions are flagged: nothing is left to analyse")
    return responses.keep_sessions(unflagged, "session is flagged")


def count_flags(flags: pd.DataFrame) -> pd.DataFrame:
    """Count the sessions that each rule flags, by scenario.

    Columns: ``scenario``, ``rule``, ``sessions``, ``only`` (flagged by no other rule). The rows
    ``flagged`` (by any rule), ``kept`` and ``all`` end each scenario; ``familiarization not
    assessed`` (no practice trial) and ``slow not assessed`` (no response time) are added if they
    apply.
    """
    rows = []
    for scenario in in_order(flags["scenario"]):
        part = flags[flags["scenario"] == scenario]
        alone = part[list(RULES)].sum(axis=1) == 1
        rows += [
            (scenario, rule, int(part[rule].sum()), int((part[rule] & alone).sum()))
            for rule in RULES
        ]
        not_assessed = {
            "familiarization": part["familiarization_trials"] == 0,
            "slow": part["mean_log_rt"].isna(),
        }
        for rule, unknown in not_assessed.items():
            if unknown.any():
                rows.append((scenario, f"{rule} not assessed", int(unknown.sum()), 0))
        flagged = int(part["flagged"].sum())
        rows.append((scenario, "flagged", flagged, int(alone.sum())))
        rows.append((scenario, "kept", len(part) - flagged, 0))
        rows.append((scenario, "all", len(part), 0))
    return pd.DataFrame(rows, columns=["scenario", "rule", "sessions", "only"])


def with_and_without(
    responses: Responses, flags: pd.DataFrame, analyse: Callable[[Responses], pd.DataFrame]
) -> pd.DataFrame:
    """Apply an analysis once without and once with the flagged sessions.

    ``analyse`` maps `Responses` to a table. The first column of the result, ``sessions``, is
    ``unflagged`` (the main analysis) or ``complete`` (all complete first sessions).
    """
    parts = []
    for name, sessions in (("unflagged", ~flags["flagged"]), ("complete", whole_sessions(flags))):
        kept = set(flags.loc[sessions, "session"])
        if not kept:
            raise BadInputError(f"no session is {name}: the analysis has nothing to work on")
        table = analyse(responses.keep_sessions(kept, f"not {name}"))
        table.insert(0, "sessions", name)
        parts.append(table)
    return pd.concat(parts, ignore_index=True)


def whole_sessions(flags: pd.DataFrame) -> pd.Series:
    """Return which sessions are complete and the first of their participant."""
    return ~flags["incomplete"] & ~flags["repeated"]
