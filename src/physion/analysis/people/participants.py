"""Answers of single participants: read, checked and cleaned; everything dropped is counted.

`read_responses` reads the export of our experiment (`response_schema`); `official_responses` reads
the raw columns of the original study. Both return `Responses`, the input of exclusions, of the
analyses of people and of the comparison with models.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.people.response_schema import SESSION_COLUMNS, TRIAL_COLUMNS, check_table
from physion.analysis.tables.csv_table import read_table, refuse_duplicates
from physion.analysis.tables.stimuli import in_order
from physion.core.errors import BadInputError
from physion.core.names import OFFICIAL_SCENARIOS, canonical_name, is_ledge

Refuse = Literal["refuse", "drop"]
Kind = Literal["people", "simulated", "all"]
"""Whose sessions are kept: those of people, of simulated participants, or of both."""

NO_ANSWER = "no answer was given"
COPY = "exact copy of another row"
CONFLICT = "another row of the same session is about the same stimulus"
UNKNOWN = "stimulus is not known"
SIMULATED = "session of a simulated participant"
PERSON = "session of a person, in a rehearsal"
REHEARSAL = "Rehearsal: participants are simulated, so no number here is about people"
"""Mark of every result that simulated participants are in."""
EXCLUDED = "on the list of stimuli to leave out"
LEDGE = "Roll stimulus with a ledge"
VOID = "the movie was interrupted"
SEVERAL = " + "
"""Between the scenarios of a session that has several."""
NO_TIME = "no response time above 0: the answer counts, its time does not"

DROPPED_COLUMNS = ("step", "scenario", "reason", "sessions", "rows")


@dataclass(frozen=True)
class Responses:
    """Participant-level data of a study.

    - ``trials``: one row a participant and trial, sorted by scenario, session, phase and trial.
      Columns: ``participant``, ``session``, ``scenario`` (ours), ``stimulus`` (canonical name),
      ``phase`` (familiarization or test), ``trial`` (int), ``yes``, ``label`` and ``correct``
      (bool), ``rt_ms`` (from the moment of the buttons; NaN where not known), ``log_rt`` (natural
      logarithm of it; NaN where not above 0), and whatever else of `TRIAL_COLUMNS` was given.
    - ``sessions``: one row a session (`SESSION_COLUMNS`, as far as given), in the order in which
      they began, or else in which they stand in the file. ``scenario`` is a `scenario_set`.
    - ``dropped``: what was left out: ``step``, ``scenario``, ``reason``, ``sessions`` (with at
      least one such row) and ``rows``.
    """

    trials: pd.DataFrame
    sessions: pd.DataFrame
    dropped: pd.DataFrame

    @property
    def test(self) -> pd.DataFrame:
        """Rows of the test phase."""
        return self.trials[self.trials["phase"] == "test"]

    @property
    def simulated_sessions(self) -> frozenset[str]:
        """Sessions of simulated participants; the mark of a trial or of the session counts."""
        tables = [table for table in (self.trials, self.sessions) if "simulated" in table]
        return frozenset().union(*(table.loc[table["simulated"], "session"] for table in tables))

    def keep_sessions(self, sessions: Collection[str], reason: str) -> Responses:
        """Return these sessions only; the others are counted as dropped for ``reason``."""
        is_dropped = ~self.trials["session"].isin(sessions)
        kept = self.sessions[self.sessions["session"].isin(sessions)].reset_index(drop=True)
        return replace(_without(self, is_dropped, "sessions", reason), sessions=kept)

    def drop_void(self) -> Responses:
        """Return the responses without answers to trials whose movie was interrupted.

        Flag sessions first: they have answered these trials.
        """
        if "void" not in self.trials:
            return self
        return _without(self, self.trials["void"].fillna("") != "", "trials", VOID)

    def drop_stimuli(self, exclude: Iterable[str] = (), ledge: bool = True) -> Responses:
        """Return the responses without the stimuli of a list and, as in the study, without Roll's
        ledges.

        Flag sessions first: rules about the sequence of answers need all answers.
        """
        unwanted = {canonical_name(name) for name in exclude}
        stimuli = self.trials["stimulus"]
        is_gone = stimuli.map(is_ledge).astype(bool) if ledge else stimuli.isna()
        cleaned = _without(self, is_gone, "stimuli", LEDGE)
        return _without(cleaned, cleaned.trials["stimulus"].isin(unwanted), "stimuli", EXCLUDED)

    def drop_rows(self, is_dropped: pd.Series, step: str, reason: str) -> Responses:
        """Return the responses without the trials where ``is_dropped`` is True, and count these."""
        return _without(self, is_dropped, step, reason)


def read_responses(
    trials: Path,
    sessions: Path | None = None,
    *,
    known: Collection[str] | None = None,
    unknown: Refuse = "refuse",
    conflicts: Refuse = "refuse",
    participants: Kind = "people",
) -> Responses:
    """Read the responses of our experiment's export.

    Parameters
    ----------
    trials, sessions
        CSV or parquet files with the columns of `response_schema`.
    known
        Names of the stimuli that may occur; None: any.
    unknown
        What to do with other stimuli.
    conflicts
        What to do with a second answer of one session to one stimulus (``drop`` keeps the first).
    participants
        Whose sessions to keep; the others are dropped and counted.

    Raises
    ------
    BadInputError
        For files that break the schema or contradict themselves, and if no session is left.
    """
    table = check_table(read_table(trials, ()), TRIAL_COLUMNS, str(trials))
    people = None
    if sessions is not None:
        people = check_table(read_table(sessions, ()), SESSION_COLUMNS, str(sessions))
    cleaned = clean(
        table, people, where=str(trials), known=known, unknown=unknown, conflicts=conflicts
    )
    return _of_kind(cleaned, participants, str(trials))


def _of_kind(cleaned: Responses, kind: Kind, where: str) -> Responses:
    """Return the sessions of one kind of participants; `BadInputError` if there is none."""
    if kind == "all":
        return cleaned
    simulated = cleaned.simulated_sessions
    answered = set(cleaned.trials["session"])
    if kind == "people" and answered <= simulated:
        raise BadInputError(
            f"{where}: only simulated participants were found ({len(answered)} sessions), and "
            "these are left out; export the study again when people have taken part, or rehearse "
            "the analysis with --simulated"
        )
    if kind == "simulated" and not answered & simulated:
        raise BadInputError(
            f"{where}: no simulated participant was found; leave out --simulated, or make some "
            "with physion experiment simulate"
        )
    if kind == "simulated":
        return cleaned.keep_sessions(simulated, PERSON)
    if not simulated:
        return cleaned
    return cleaned.keep_sessions(set(cleaned.sessions["session"]) - simulated, SIMULATED)


def clean(
    trials: pd.DataFrame,
    sessions: pd.DataFrame | None = None,
    *,
    where: str = "responses",
    known: Collection[str] | None = None,
    unknown: Refuse = "refuse",
    conflicts: Refuse = "refuse",
) -> Responses:
    """Return the responses of a table that `check_table` has typed; see `read_responses`.

    Raises `BadInputError` for a session with two participants, or with two scenarios in one block
    or without blocks, a stimulus with two
    labels or in two scenarios, a ``correct`` that contradicts response and label, or a trial whose
    session is not in ``sessions``.
    """
    if trials.empty:
        raise BadInputError(f"{where} has no row")
    table = trials.assign(
        scenario=_scenarios(trials["scenario"]), stimulus=trials["stimulus"].map(canonical_name)
    )
    people = _sessions(table, sessions, where)
    nothing = pd.DataFrame(columns=list(DROPPED_COLUMNS))
    cleaned = Responses(table.reset_index(drop=True), people, nothing)
    cleaned = _without(cleaned, cleaned.trials["response"] == "", "reading", NO_ANSWER)
    if cleaned.trials.empty:
        raise BadInputError(f"{where} holds no answer")
    cleaned = _without(cleaned, cleaned.trials.duplicated(), "reading", COPY)
    cleaned = _known(cleaned, known, unknown, where)
    cleaned = _one_answer_each(cleaned, conflicts, where)
    return replace(cleaned, trials=_derived(cleaned.trials, where))


def _scenarios(names: pd.Series) -> pd.Series:
    """Return our spelling of the eight scenarios; another scenario keeps its name."""
    return names.map({name: _ours(name) for name in names.unique()})


def _ours(name: str) -> str:
    return OFFICIAL_SCENARIOS.get(name.strip().lower(), name.strip().lower())


def _sessions(trials: pd.DataFrame, given: pd.DataFrame | None, where: str) -> pd.DataFrame:
    """Return the table of sessions, checked against the trials.

    The scenario of a session of several blocks is the `scenario_set` of its scenarios.
    """
    keys = ["session", "participant", "scenario"]
    pairs = trials[keys[:2]].drop_duplicates()
    twice = pd.concat([pairs[pairs["session"].duplicated()], _unexplained_scenarios(trials)])
    if len(twice):
        raise BadInputError(
            f"{where}: session {twice['session'].iloc[0]!r} belongs to two participants or, "
            "without blocks, to two scenarios"
        )
    answered = trials.groupby("session", sort=False)["scenario"].unique()
    cleaned = pairs.assign(scenario=pairs["session"].map(answered.map(scenario_set)))
    cleaned = cleaned.reset_index(drop=True)
    if given is None:
        return cleaned
    refuse_duplicates(given["session"], "table of sessions")
    listed = given["scenario"].str.split().map(lambda names: scenario_set(map(_ours, names)))
    given = given.assign(scenario=listed)
    joined = cleaned.merge(given[keys], on="session", how="left", suffixes=("", "_given"))
    # An unfinished session lacks the scenarios of its last blocks.
    both = zip(joined["scenario"], joined["scenario_given"].fillna(""), strict=True)
    absent = [not set(scenarios_in(here)) <= set(scenarios_in(there)) for here, there in both]
    wrong = (joined["participant"] != joined["participant_given"]) | np.array(absent, dtype=bool)
    if wrong.any():
        raise BadInputError(
            f"{where}: session {joined.loc[wrong, 'session'].iloc[0]!r} is not, or is another one, "
            "in the table of sessions"
        )
    if "started_at" in given:
        began = pd.to_datetime(given["started_at"], errors="coerce", utc=True, format="ISO8601")
        given = given.loc[began.sort_values(kind="stable", na_position="last").index]
    return given.reset_index(drop=True)


def _unexplained_scenarios(trials: pd.DataFrame) -> pd.DataFrame:
    """Return rows of sessions with two scenarios that are not, one each, those of their blocks."""
    pairs = trials.assign(block=trials.get("block", pd.NA))
    pairs = pairs[["session", "block", "scenario"]].drop_duplicates()
    several = pairs[pairs.groupby("session")["scenario"].transform("nunique") > 1]
    own = several.groupby(["session", "block"], dropna=False)["scenario"].transform("nunique")
    return several[several["block"].isna() | (own > 1)]


def scenario_set(scenarios: Iterable[str]) -> str:
    """Return the scenarios of a session as one text, the same for all orders of its blocks."""
    return SEVERAL.join(in_order(pd.Series(list(scenarios), dtype=str)))


def scenarios_in(name: str) -> list[str]:
    """Return the scenarios of a `scenario_set`."""
    return name.split(SEVERAL)


def _known(
    cleaned: Responses, known: Collection[str] | None, unknown: Refuse, where: str
) -> Responses:
    if known is None:
        return cleaned
    names = {canonical_name(name) for name in known}
    is_unknown = ~cleaned.trials["stimulus"].isin(names)
    if is_unknown.any() and unknown == "refuse":
        first = cleaned.trials.loc[is_unknown, "stimulus"].iloc[0]
        raise BadInputError(
            f"{where}: stimulus {first!r} is not known "
            f"({int(is_unknown.sum())} such rows); give all stimuli, or ask to drop unknown ones"
        )
    return _without(cleaned, is_unknown, "reading", UNKNOWN)


def _one_answer_each(cleaned: Responses, conflicts: Refuse, where: str) -> Responses:
    rows = cleaned.trials.sort_values("trial", kind="stable")
    second = rows.duplicated(["session", "phase", "stimulus"])
    second |= rows.duplicated(["session", "phase", "trial"])
    second = second.reindex(cleaned.trials.index)
    if second.any() and conflicts == "refuse":
        row = cleaned.trials[second].iloc[0]
        raise BadInputError(
            f"{where}: session {row['session']!r} has two answers to trial {row['trial']} "
            f"({row['stimulus']!r}, {row['phase']}); clean the file, or ask to keep the first"
        )
    return _without(cleaned, second, "reading", CONFLICT)


def _derived(trials: pd.DataFrame, where: str) -> pd.DataFrame:
    """Add booleans, log response times and order; refuse contradictions."""
    yes, label = trials["response"] == "yes", trials["label"].astype(bool)
    correct = yes == label
    if "correct" in trials:
        wrong = (trials["correct"].astype("boolean") != correct).fillna(False).astype(bool)
        if wrong.any():
            row = trials[wrong].iloc[0]
            raise BadInputError(
                f"{where}: session {row['session']!r}, stimulus {row['stimulus']!r}: correct is "
                f"{row['correct']}, but the response {row['response']} and the label disagree"
            )
    labels = trials.groupby("stimulus")["label"].nunique()
    if (labels > 1).any():
        raise BadInputError(f"{where}: stimulus {labels[labels > 1].index[0]!r} has two labels")
    in_test = trials[trials["phase"] == "test"]
    scenarios = in_test.groupby("stimulus")["scenario"].unique()
    several = scenarios[scenarios.map(len) > 1]
    if len(several):
        raise BadInputError(
            f"{where}: stimulus {several.index[0]!r} is in two scenarios, "
            f"{' and '.join(several.iloc[0])}; give its versions names of their own"
        )
    rt = trials["rt_ms"].to_numpy(dtype=np.float64)
    derived = trials.drop(columns="response").assign(
        trial=trials["trial"].astype(np.int64),
        yes=yes, label=label, correct=correct, log_rt=log_ms(rt),
    )  # fmt: skip
    order = ["scenario", "session", "phase", "trial"]
    return derived.sort_values(order, kind="stable").reset_index(drop=True)


def log_ms(rt_ms: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Return the natural logarithm of response times in ms; NaN if not above 0 or unknown."""
    values = np.asarray(rt_ms, dtype=np.float64)
    return np.log(values, out=np.full_like(values, np.nan), where=values > 0)


def _without(cleaned: Responses, is_dropped: pd.Series, step: str, reason: str) -> Responses:
    """Return the responses without the rows where ``is_dropped`` is True, and count these."""
    if not is_dropped.any():
        return cleaned
    counts = _counted(cleaned.trials[is_dropped], step, reason)
    parts = [part for part in (cleaned.dropped, counts) if len(part)]
    return replace(
        cleaned,
        trials=cleaned.trials[~is_dropped].reset_index(drop=True),
        dropped=pd.concat(parts, ignore_index=True),
    )


def _counted(rows: pd.DataFrame, step: str, reason: str) -> pd.DataFrame:
    """Count ``rows`` by scenario, with `DROPPED_COLUMNS`."""
    counts = rows.groupby("scenario", sort=False)["session"].agg(sessions="nunique", rows="size")
    return counts.reset_index().assign(step=step, reason=reason)[list(DROPPED_COLUMNS)]


def missing_times(responses: Responses) -> pd.DataFrame:
    """Count the test answers without a usable response time, as rows of ``dropped``.

    They are not in `Responses.dropped`, since the answers themselves are kept.
    """
    test = responses.test
    return _counted(test[test["log_rt"].isna()], "response times", NO_TIME)


def check_labels(responses: Responses, labels: Mapping[str, bool]) -> None:
    """Raise `BadInputError` with the first stimulus whose label contradicts the official one."""
    label_of = responses.trials.drop_duplicates("stimulus").set_index("stimulus")["label"]
    official = label_of.index.map({canonical_name(name): value for name, value in labels.items()})
    wrong = pd.Series(official, index=label_of.index).notna() & (official != label_of.to_numpy())
    if wrong.any():
        raise BadInputError(
            f"the responses say that {label_of.index[wrong.to_numpy()][0]!r} ends otherwise than "
            f"the labels say ({int(wrong.sum())} such stimuli)"
        )
