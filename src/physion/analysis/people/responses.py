"""Answers of single participants: read, checked and cleaned; everything dropped is counted.

`read_responses` reads the export of our experiment (`TRIAL_COLUMNS`, `SESSION_COLUMNS`);
`read_official_responses` reads the raw columns of the original study. Both return `Responses`, the
input of exclusions, of the analyses of people and of the comparison with models.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.names import OFFICIAL_SCENARIOS, canonical_name, is_ledge, scenario_of
from physion.core.tables import Column, check_table, must, read_csv, read_table, refuse_duplicates

# Schema of participant-level data, shared by the experiment's export and the analysis.
#
# Two tables make a study's data: one row per participant and trial (`TRIAL_COLUMNS`) and one row
# per session (`SESSION_COLUMNS`). The experiment exports exactly these columns and writes its data
# dictionary with `data_dictionary`; the analysis refuses a file that violates them and names the
# row.

PHASES = ("familiarization", "test")
DAY_MS = 86_400_000.0


TRIAL_COLUMNS: tuple[Column, ...] = (
    must("participant", "text", "Keyed hash of the participant's id; never the id itself"),
    must("session", "text", "One run through the experiment by one participant, unique"),
    must("scenario", "text", "Scenario of the trial"),
    must("stimulus", "text", "Name of the trial that was shown"),
    must("phase", "choice", "With feedback (familiarization) or without (test)", choices=PHASES),
    must("trial", "integer", "Place in the order of its phase in the session, from 0; attention "
         "checks, which are not in this table, have places too", low=0),
    Column("response", "choice", "Will the agent touch the patient? Empty: no answer was given",
           choices=("yes", "no"), required=True),
    must("label", "flag", "Does the agent touch the patient?"),
    must("simulated", "flag", "Made by a program for piloting: no person"),
    Column("rt_ms", "number", "Response time: from the moment the buttons are enabled to the "
           "answer", unit="ms", low=-DAY_MS, high=DAY_MS, required=True),
    Column("buttons", "choice", "The two buttons from left to right", choices=("yes-no", "no-yes")),
    Column("correct", "flag", "response equals label; recomputed, and refused if it contradicts"),
    Column("input", "choice", "How the answer was given", choices=("mouse", "touch", "keyboard")),
    Column("look", "choice", "Colours of the stimulus", choices=("free", "redyellow")),
    Column("fixation_ms", "number", "How long the cross was shown", unit="ms", low=0, high=DAY_MS),
    Column("cue_ms", "number", "How long the first frame was cued", unit="ms", low=0, high=DAY_MS),
    Column("frames_expected", "integer", "Frames of the observed movie", low=0),
    Column("frames_shown", "integer", "Frames that the browser presented", low=0),
    Column("frames_dropped", "integer", "Frames that the browser decoded and dropped", low=0),
    Column("movie_ms", "number", "From the first to the last frame", unit="ms", low=0, high=DAY_MS),
    Column("visibility_changes", "integer", "How often the page was hidden or shown again", low=0),
    Column("window_width", "integer", "Inner width of the window", unit="px", low=0),
    Column("window_height", "integer", "Inner height of the window", unit="px", low=0),
    Column("break_ms", "number", "Duration of the break before the trial; empty: there was none",
           unit="ms", low=0, high=DAY_MS),
    Column("resumed", "flag", "The page was loaded anew while this trial was the next one"),
    Column("showings", "integer", "How often the movie was shown, over all loads of the page",
           low=0),
    Column("void", "choice", "What interrupted the movie, so that the answer does not count: the "
           "page was hidden, a dialog open, or the window too small; empty: nothing",
           choices=("hidden", "dialog", "window")),
    Column("answered_at", "time", "When the server stored the answer"),
    Column("condition", "text", "Between-subject condition of the session; empty: there is none"),
)  # fmt: skip
"""One row per participant and trial."""

SESSION_COLUMNS: tuple[Column, ...] = (
    must("participant", "text", "As in the trials"),
    must("session", "text", "As in the trials; unique here"),
    must("scenario", "text", "Scenario of the session"),
    must("simulated", "flag", "As in the trials"),
    Column("study", "text", "Name and version of the study"),
    Column("recruited_by", "text", "Where the participant came from"),
    Column("started_at", "time", "When the session began"),
    Column("finished_at", "time", "When the last page was sent; empty: not finished"),
    Column("consent_version", "text", "Version of the consent text that was agreed to"),
    Column("consented_at", "time", "When it was agreed to"),
    Column("instructed_at", "time", "When the instructions were done"),
    Column("comprehension_attempts", "integer",
           "How often the questions about the instructions were answered", low=0),
    Column("screened_out", "choice", "Which check ended the session early; empty: none did",
           choices=("comprehension", "practice")),
    Column("ready_at", "time", "When the page between practice and test was sent"),
    Column("buttons", "choice", "The buttons from left to right", choices=("yes-no", "no-yes")),
    Column("language", "text", "Language of the pages"),
    Column("order_number", "integer", "Prepared order of trials, from 1; 0: an order of its own",
           low=0),
    Column("loads", "integer", "How often the page was loaded; more than 1: it was resumed", low=0),
    Column("replayed", "integer", "Trials shown more often than the study allows", low=0),
    Column("implausible", "text", "Why no person can have made the session, as the server judged: "
           "fast answers, no media, short; empty: nothing is wrong"),
    Column("practice_repeats", "integer", "How often the practice was repeated", low=0),
    Column("attention_failed", "integer", "Number of failed attention checks", low=0),
    Column("failed_checks", "text", "Checks of the lab that the session failed: practice, "
           "attention; empty: none"),
    Column("age", "integer", "Age", unit="years", low=0, high=130),
    Column("gender", "text", "Gender, in the words of the questionnaire"),
    Column("education", "text", "Highest education, in the words of the questionnaire"),
    Column("difficulty", "integer", "How difficult was the task? 1 very easy, 5 very hard",
           low=1, high=5),
    Column("technical_problems", "flag", "Did the participant report technical problems?"),
    Column("feedback", "text", "Free text"),
    Column("user_agent", "text", "Browser and system, as the browser says"),
    Column("refresh_hz", "number", "Refresh rate of the screen", unit="Hz", low=0, high=1000),
    Column("screen_width", "integer", "Width of the screen", unit="px", low=0),
    Column("screen_height", "integer", "Height of the screen", unit="px", low=0),
    Column("pixel_ratio", "number", "Device pixels in one CSS pixel", low=0, high=100),
    Column("touch", "flag", "Does the device have a touch screen?"),
    Column("condition", "text", "Between-subject condition; empty: the study has none"),
)  # fmt: skip
"""One row per session; demographics are asked at its end, so that they are empty in broken ones."""


Participants = Literal["people", "simulated", "all"]
"""Whose sessions are kept: of people, of simulated participants, or of both."""

NO_ANSWER = "no answer was given"
COPY = "exact copy of another row"
SIMULATED = "session of a simulated participant"
PERSON = "session of a person, in a rehearsal"
REHEARSAL = "Rehearsal: participants are simulated, so no number here is about people"
"""Mark of every result that simulated participants are in."""
EXCLUDED = "on the list of stimuli to leave out"
LEDGE = "Roll stimulus with a ledge"
VOID = "the movie was interrupted"
NO_TIME = "no response time above 0: the answer counts, its time does not"

DROPPED_COLUMNS = ("step", "scenario", "reason", "sessions", "rows")


@dataclass(frozen=True)
class Responses:
    """Participant-level data of a study.

    - ``trials``: one row per participant and trial, sorted by scenario, session, phase and trial.
      Columns: ``participant``, ``session``, ``scenario`` (ours), ``stimulus`` (canonical name),
      ``phase`` (familiarization or test), ``trial`` (int), ``yes``, ``label`` and ``correct``
      (bool), ``rt_ms`` (from the moment of the buttons; NaN where not known), ``log_rt`` (natural
      logarithm of it; NaN where not above 0), and whatever else of `TRIAL_COLUMNS` was given.
    - ``sessions``: one row per session (`SESSION_COLUMNS`, as far as given), in the order in which
      they began, or else in which they stand in the file.
    - ``dropped``: what was left out: ``step``, ``scenario``, ``reason``, ``sessions`` (with at
      least one such row) and ``rows``.
    - ``own``: columns of ``sessions`` with answers to the lab's own questions.
    """

    trials: pd.DataFrame
    sessions: pd.DataFrame
    dropped: pd.DataFrame
    own: tuple[str, ...] = ()

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
    participants: Participants = "people",
) -> Responses:
    """Read the responses of our experiment's export.

    Parameters
    ----------
    trials, sessions
        CSV or parquet files with `TRIAL_COLUMNS` and `SESSION_COLUMNS`.
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
    return _of_kind(clean(table, people, where=str(trials)), participants, str(trials))


QUESTIONS_FILE = "questions.csv"
"""File with the answers to the lab's own questions, in the folder of the exported responses."""
MOST_ANSWERS = 20
"""Largest number of different answers that are groups of people; more are free texts."""


def with_own_questions(responses: Responses, trials: Path) -> Responses:
    """Return the responses with the answers to the lab's own questions, from the file next to them.

    Free texts are left out. Without the file the responses are returned as they are. Raises
    `BadInputError` for a session with two rows.
    """
    path = trials.parent / QUESTIONS_FILE
    if not path.is_file() or path.read_bytes().count(b"\n") < 2:
        return responses  # nobody has answered yet
    table = read_table(path, ("session",)).apply(_numbers).astype({"session": str})
    refuse_duplicates(table["session"], str(path))
    known = set(responses.sessions.columns)
    own = {
        name: name if name not in known else f"own_{name}"
        for name in table.columns.difference(["session", "participant"], sort=False)
        if is_number(table[name]) or table[name].nunique() <= MOST_ANSWERS
    }
    answers = table[["session", *own]].rename(columns=own)
    joined = responses.sessions.merge(answers, on="session", how="left")
    return replace(responses, sessions=joined, own=tuple(own.values()))


def _numbers(column: pd.Series) -> pd.Series:
    """Return a column of texts as numbers, if all that are not empty are numbers."""
    given = column[column != ""]
    numbers = pd.to_numeric(given, errors="coerce")
    if column.name == "session" or given.empty or numbers.isna().any():
        return column
    return numbers.reindex(column.index)


def is_number(column: pd.Series) -> bool:
    """Return whether a column has numbers, and not only true and false."""
    kinds = pd.api.types
    return bool(kinds.is_numeric_dtype(column) and not kinds.is_bool_dtype(column))


def _of_kind(cleaned: Responses, kind: Participants, where: str) -> Responses:
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
) -> Responses:
    """Return the responses of a table that `check_table` has typed; see `read_responses`.

    Raises `BadInputError` for a session of two participants or scenarios; a stimulus with two
    labels or in two scenarios; a ``correct`` that contradicts response and label; and a trial whose
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
    _refuse_two_answers(cleaned.trials, where)
    return replace(cleaned, trials=_derived(cleaned.trials, where))


def _scenarios(names: pd.Series) -> pd.Series:
    """Return our spelling of the eight scenarios; another scenario keeps its name."""
    return names.map({name: _ours(name) for name in names.unique()})


def _ours(name: str) -> str:
    return OFFICIAL_SCENARIOS.get(name.strip().lower(), name.strip().lower())


def _sessions(trials: pd.DataFrame, given: pd.DataFrame | None, where: str) -> pd.DataFrame:
    """Return the table of sessions, checked against the trials."""
    keys = ["session", "participant", "scenario"]
    cleaned = trials[keys].drop_duplicates().reset_index(drop=True)
    twice = cleaned["session"].duplicated()
    if twice.any():
        raise BadInputError(
            f"{where}: session {cleaned.loc[twice, 'session'].iloc[0]!r} belongs to two "
            "participants or scenarios"
        )
    if given is None:
        return cleaned
    refuse_duplicates(given["session"], "table of sessions")
    given = given.assign(scenario=_scenarios(given["scenario"]))
    joined = cleaned.merge(given[keys], on="session", how="left", suffixes=("", "_given"))
    wrong = joined["participant"] != joined["participant_given"]
    wrong |= joined["scenario"] != joined["scenario_given"]
    if wrong.any():
        raise BadInputError(
            f"{where}: session {joined.loc[wrong, 'session'].iloc[0]!r} is missing from the "
            "sessions table, or differs there"
        )
    if "started_at" in given:
        began = pd.to_datetime(given["started_at"], errors="coerce", utc=True, format="ISO8601")
        given = given.loc[began.sort_values(kind="stable", na_position="last").index]
    return given.reset_index(drop=True)


def _refuse_two_answers(trials: pd.DataFrame, where: str) -> None:
    """Refuse a session with two answers to one stimulus, or at one place in its order."""
    second = trials.duplicated(["session", "phase", "stimulus"])
    second |= trials.duplicated(["session", "phase", "trial"])
    if second.any():
        row = trials[second].iloc[0]
        raise BadInputError(
            f"{where}: session {row['session']!r} has two answers to trial {row['trial']} "
            f"({row['stimulus']!r}, {row['phase']}); keep one row"
        )


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


def pooling_warnings(test: pd.DataFrame) -> list[str]:
    """Return a warning for answers that an analysis takes together though they may differ.

    These are answers to two looks of one scenario, and answers of one person to several scenarios,
    whom the mean over scenarios takes for several people. ``test``: test rows of `Responses`.
    """
    found = []
    if "look" in test:
        looks = test[test["look"] != ""].groupby("scenario", sort=False)["look"].nunique()
        found += [
            f"{name}: answers to free and to red and yellow objects are taken together; choose one "
            "with --where look=free or look=redyellow"
            for name in looks.index[looks > 1]
        ]
    scenarios = test.groupby("participant")["scenario"].nunique()
    if several := int((scenarios > 1).sum()):
        found.append(
            f"{several} of {len(scenarios)} participants answered several scenarios: intervals of "
            "means over scenarios, and tests of backgrounds, take them for different people in "
            "each, and say too little of how people differ"
        )
    return found


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


# Reader of participant-level answers in the raw columns of the original study.
#
# The study's exports are ``human_responses-<study>-<iteration>.csv`` (150 test trials a session)
# and ``familiarization_human_responses-...`` (10 trials). Their ``rt`` starts before the cue.

RT_OFFSET_MS = 2500.0
"""What the study subtracts from ``rt``. The cue of 2000 ms and 1500 ms of movie come before the
buttons, so that about 1000 ms of waiting remain in its response times: they compare with each
other, not with response times of our experiment."""

COLUMNS = ("gameID", "trialNum", "stim_ID", "response", "target_hit_zone_label", "rt")
"""Columns that must be there; ``prolificIDAnon`` (or ``prolificID``), ``correct``, ``choices``,
``condition`` are read where they are."""

_STUDY = re.compile(r"human_responses-(?P<study>[a-zA-Z]+)")
_PEOPLE = ("prolificIDAnon", "prolificID")


def read_official_responses(files: Sequence[Path]) -> Responses:
    """Read responses from the raw files of the study, test and familiarization together.

    The scenario of a file is the one in its name, else the one of its stimuli. A session is a
    ``gameID``; its participant is the Prolific id if there is one. `RT_OFFSET_MS` is subtracted
    from ``rt``.
    """
    if not files:
        raise BadInputError("no file of responses was given")
    raw = pd.concat([_file(path) for path in files], ignore_index=True)
    where = f"{files[0]}" if len(files) == 1 else f"{files[0]} and {len(files) - 1} more"
    table = check_table(raw, TRIAL_COLUMNS, where)
    return clean(table, where=where)


def _file(path: Path) -> pd.DataFrame:
    """Read one file into our columns; text stays text."""
    raw = read_csv(path, COLUMNS)
    condition = raw["condition"] if "condition" in raw else pd.Series("prediction", index=raw.index)
    is_practice = condition.str.contains("familiarization")
    if "condition" not in raw and path.name.startswith("familiarization"):
        is_practice |= True
    # Where the number is missing, the order of the rows is the order of the answers.
    order = raw.groupby(["gameID", is_practice], sort=False).cumcount().astype(str)
    red = raw["stim_ID"].str.contains("-redyellow") | ("-redyellow" in path.name)
    position = raw["trialNum"].where(~raw["trialNum"].str.lower().isin(("", "nan")), order)
    table = pd.DataFrame(
        {
            "participant": _participant(raw),
            "session": raw["gameID"],
            "scenario": _scenario(path, raw["stim_ID"]),
            "stimulus": raw["stim_ID"].map(canonical_name),
            "look": np.where(red, "redyellow", "free"),
            "phase": np.where(is_practice, "familiarization", "test"),
            "trial": position,
            "response": raw["response"].str.lower().where(raw["response"].str.lower() != "nan", ""),
            "label": raw["target_hit_zone_label"],
            "simulated": False,
            "rt_ms": _response_time(raw["rt"], path),
        }
    )
    if "correct" in raw:
        table["correct"] = raw["correct"]
    if "choices" in raw:
        table["buttons"] = raw["choices"].map(_buttons)
    return table


def _participant(raw: pd.DataFrame) -> pd.Series:
    for column in _PEOPLE:
        if column in raw:
            return raw[column].where(raw[column] != "", raw["gameID"])
    return raw["gameID"]


def _scenario(path: Path, stimuli: pd.Series) -> str:
    match = _STUDY.search(path.name)
    if match and match["study"].lower() in OFFICIAL_SCENARIOS:
        return OFFICIAL_SCENARIOS[match["study"].lower()]
    scenarios = {scenario_of(canonical_name(name)) for name in stimuli.unique()} - {None}
    if len(scenarios) != 1:
        raise BadInputError(
            f"{path}: neither its name nor its stimuli say which scenario it is; name it "
            "human_responses-SCENARIO-....csv"
        )
    return str(scenarios.pop())


def _response_time(rt: pd.Series, path: Path) -> pd.Series:
    known = ~rt.str.lower().isin(("", "nan"))
    numbers = pd.to_numeric(rt.where(known), errors="coerce")
    broken = known & ~np.isfinite(numbers)
    if broken.any():
        row = int(np.flatnonzero(broken)[0])
        raise BadInputError(f"{path}: row {row + 1} of column 'rt' holds {rt.iloc[row]!r}")
    return numbers - RT_OFFSET_MS


def _buttons(choices: str) -> str:
    """Return the order of the buttons from ``["YES", "NO"]``, ``['NO' 'YES']`` or ``YES,NO``."""
    words = re.findall(r"yes|no", choices.lower())
    return "-".join(words) if sorted(words) == ["no", "yes"] else ""


# Choose the sessions to analyse by the values of their columns, such as ``condition=fast``.

CHOSEN_BY = (
    "condition",
    "language",
    "recruited_by",
    "gender",
    "education",
    "buttons",
    "look",
    "study",
)
"""Columns by which sessions can be chosen, in the table of sessions or in the trials."""


def keep_where(responses: Responses, chosen: Sequence[str]) -> Responses:
    """Return the responses of the sessions that have the given values; the others are counted.

    Parameters
    ----------
    responses
        Answers of participants.
    chosen
        Texts such as ``condition=fast``. Several of one column are alternatives; of several
        columns, a session must fit all.

    Raises
    ------
    BadInputError
        A text has no ``=``, the responses lack the column, or no session has such a value.
    UnknownNameError
        The column is not in `CHOSEN_BY`.
    """
    wanted: dict[str, set[str]] = {}
    for text in chosen:
        column, equals, value = text.partition("=")
        if not equals:
            raise BadInputError(
                f"--where {text}: give a column and a value, such as condition=fast"
            )
        if column not in CHOSEN_BY:
            raise UnknownNameError("column of sessions", column, CHOSEN_BY)
        wanted.setdefault(column, set()).add(value)
    for column, values in wanted.items():
        found = _values(responses, column)
        missing = sorted(values - set(found))
        if missing:
            known = ", ".join(sorted(set(found))) or "none"
            raise BadInputError(
                f"no session has {column}={missing[0]}; the values of {column} are: {known}"
            )
        kept = set(found.index[found.isin(values)])
        responses = responses.keep_sessions(kept, f"{column} is not {' or '.join(sorted(values))}")
    return responses


def _values(responses: Responses, column: str) -> pd.Series:
    """Return the values of a column that are not empty, by session."""
    for table in (responses.sessions, responses.trials):
        if column in table:
            values = table.drop_duplicates("session").set_index("session")[column].astype(str)
            return values[values != ""]
    raise BadInputError(f"the responses have no column {column}; give the table of sessions too")
