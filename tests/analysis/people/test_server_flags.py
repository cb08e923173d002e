"""What the experiment's server found: implausible sessions, repeated and interrupted movies."""

from __future__ import annotations

import pandas as pd

from physion.analysis.people.exclusions import flag_from_server
from physion.analysis.people.responses import VOID, Responses

SESSIONS = pd.DataFrame({
    "session": ["a", "b", "c"], "implausible": ["", "no media, short", ""],
    "replayed": pd.array([0, None, 2], dtype="Int64"),
})  # fmt: skip
TRIALS = pd.DataFrame({
    "session": ["a", "a", "b"], "scenario": "drop", "void": ["", "hidden", ""],
})  # fmt: skip
NOTHING = pd.DataFrame(columns=["step", "scenario", "reason", "sessions", "rows"])


def test_sessions_are_flagged_by_what_the_server_found() -> None:
    responses = Responses(TRIALS, SESSIONS, NOTHING)
    measures = SESSIONS[["session"]].iloc[::-1].reset_index(drop=True)
    assert list(flag_from_server(responses, measures, "implausible")) == [False, True, False]
    assert list(flag_from_server(responses, measures, "replayed")) == [True, False, False]
    old = Responses(TRIALS, SESSIONS[["session"]], NOTHING)
    assert not flag_from_server(old, measures, "implausible").any()


def test_answers_after_an_interrupted_movie_are_dropped_and_counted() -> None:
    kept = Responses(TRIALS, SESSIONS, NOTHING).drop_void()
    assert list(kept.trials["void"]) == ["", ""]
    assert kept.dropped[["reason", "sessions", "rows"]].to_numpy().tolist() == [[VOID, 1, 1]]
    old = Responses(TRIALS.drop(columns="void"), SESSIONS, NOTHING)
    assert len(old.drop_void().trials) == 3
