"""Measures of a session for the exclusion rules: streaks, alternations, accuracy, response
times.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.people.completeness import Expected, expected_by_session
from physion.analysis.people.participants import Responses
from physion.core.errors import BadInputError


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
    """Return the measures for the rules, one row a session, in the order of ``responses.sessions``.

    A session of several blocks is measured as a whole, over the answers in the order given.

    ``expected``: the test stimuli by scenario, or by session if people see subsets; by default
    those that at least half of the scenario's sessions answered (`completeness`). Columns:
    ``session``, ``participant``, ``scenario``, ``expected`` (number of stimuli), ``missing`` (those
    of them without an answer), ``trials``, ``accuracy``, ``yes``, ``mean_log_rt``,
    ``median_log_rt``, ``no_log_rt`` (trials without a response time above 0), ``longest_streak``,
    ``longest_alternation``, ``longest_alternation_from_first``, ``familiarization_trials``,
    ``familiarization_correct``. Raises `BadInputError` if no session has a test answer.
    """
    test = responses.test
    if test.empty:
        raise BadInputError(
            f"{len(responses.sessions)} session(s) hold practice alone and no test answer: "
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
