"""One table of many prediction files: how accurate, how like people, made by which versions.

Each file is compared by itself, on the stimuli that people saw and it predicts, so that files made
on different sets of trials can stand in one table; the column ``stimuli`` says on how many. A file
that cannot be compared is not dropped silently: it stands in `Leaderboard.refused` with the reason.
A model that lacks stimuli ranks after those that lack none, whatever its scores.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.answers import Answers, share
from physion.analysis.bootstrap import Bootstrap
from physion.analysis.comparison import NOT_PREDICTED, Comparison, compare
from physion.analysis.csv_table import read_csv
from physion.analysis.exclusions import (
    PREREGISTERED,
    ExclusionRules,
    flag_sessions,
    without_flagged,
)
from physion.analysis.kappa import cross_kappa
from physion.analysis.model_people import models_of
from physion.analysis.participants import Responses, check_labels
from physion.analysis.people import all_answers, draws_of_people
from physion.analysis.predictions import REQUIRED, check_predictions, name_models
from physion.analysis.stimuli import SCENARIOS
from physion.analysis.tables import MEAN, POOLED
from physion.errors import BadInputError, UnknownNameError

Array = npt.NDArray[np.float64]

SCORED = ("accuracy", "difference", "r", "rmsd")
"""Scores by `scores.scores` that the table shows, each with ``_low`` and ``_high``."""

LOWER_IS_BETTER = ("rmsd",)

COLUMNS = (
    "rank",
    "model",
    "readout",
    "training",
    "file",
    "scenarios",
    "of_scenarios",
    "stimuli",
    "of_stimuli",
    *(f"{score}{end}" for score in (*SCORED, "kappa") for end in ("", "_low", "_high")),
    "versions",
    "agent",
    "reason",
)
"""Columns of the table. ``scenarios`` and ``stimuli`` count what the scores rest on, out of
``of_scenarios`` and ``of_stimuli``: what people saw or, without people, what all files name.
``agent`` is the name by which the file's own rows are told apart; ``reason`` says what a score
rests on where that is not everything, and why a score is NaN."""

KAPPA_NEEDS = "kappa: needs the answers of single participants"


@dataclass(frozen=True)
class Leaderboard:
    """The ranked table (`COLUMNS`), what was left out of each file (``file``, ``agent``,
    ``scenario``, ``reason``, ``stimuli``), the files that could not be compared (``file``,
    ``reason``), the answers of people that were left out (`Responses.dropped`; None: there were no
    single answers), and the choices in words."""

    table: pd.DataFrame
    dropped: pd.DataFrame
    refused: pd.DataFrame
    dropped_answers: pd.DataFrame | None
    settings: Mapping[str, str]


def leaderboard(
    files: Sequence[Path],
    humans: pd.DataFrame | None = None,
    labels: Mapping[str, bool] | None = None,
    responses: Responses | None = None,
    *,
    rules: ExclusionRules = PREREGISTERED,
    expected: Mapping[str, int] | None = None,
    scenario: str = MEAN,
    exclude: Iterable[str] = (),
    exclude_ledge: bool = True,
    bootstrap: Bootstrap | None = None,
) -> Leaderboard:
    """Score every model of every file, best accuracy first; see `sort_leaderboard`.

    ``humans``, ``labels``, ``exclude``, ``exclude_ledge``: as `comparison.compare`. ``responses``:
    answers of single participants, of which the sessions that ``rules`` flag are left out; they
    give kappa and, where ``humans`` is None, stand in for it. ``expected``: see
    `exclusions.flag_sessions`. ``scenario``: one of the eight, *mean* (each counting the same) or
    *pooled*.

    Raises `BadInputError` where there is no file, or not one that can be compared; where no session
    is left; where the outcomes of the responses contradict ``labels``.
    """
    if not files:
        raise BadInputError("no file of predictions was given")
    if scenario not in (*SCENARIOS, MEAN, POOLED):
        raise UnknownNameError("scenario", scenario, (*SCENARIOS, MEAN, POOLED))
    draws = bootstrap or Bootstrap()
    unwanted = tuple(exclude)
    kept, flagging = _unflagged(responses, rules, expected, labels)
    test = None if kept is None else kept.test
    people, outcomes = _people(humans, labels, test)
    answers = {} if test is None else {each.scenario: each for each in all_answers(test)}
    tables, dropped, refused, rested = [], [], [], []
    settings: Mapping[str, str] = {}
    for path in files:
        try:
            rows, versions = _read(path)
            found = compare(
                rows,
                people,
                outcomes,
                exclude=unwanted,
                exclude_ledge=exclude_ledge,
                bootstrap=draws,
            )
            own = _score(found, rows, answers, scenario, draws)
        except BadInputError as error:
            refused.append({"file": str(path), "reason": str(error)})
            continue
        tables.append(own.assign(file=str(path), versions=own["agent"].map(versions)))
        dropped.append(found.dropped.assign(file=str(path)))
        rested.append(found.stimuli[["agent", "scenario", "stimulus"]].assign(file=str(path)))
        settings = found.settings
    if not tables:
        raise BadInputError(f"no file can be compared: {refused[0]['reason']}")
    left_out = pd.concat(dropped, ignore_index=True)
    asked = _asked(pd.concat(rested, ignore_index=True), left_out)
    table = _with_asked(pd.concat(tables, ignore_index=True), asked, scenario)
    order = ["file", "agent", "scenario", "reason", "stimuli"]
    return Leaderboard(
        sort_leaderboard(table.reindex(columns=list(COLUMNS))),
        left_out[order],
        pd.DataFrame(refused, columns=["file", "reason"]),
        None if kept is None else kept.dropped,
        {**settings, **_words(scenario, test is not None), **flagging},
    )


def _unflagged(
    responses: Responses | None,
    rules: ExclusionRules,
    expected: Mapping[str, int] | None,
    labels: Mapping[str, bool] | None,
) -> tuple[Responses | None, dict[str, str]]:
    """The responses without flagged sessions, and how they were flagged in words."""
    if responses is None:
        return None, {}
    if labels is not None:
        check_labels(responses, labels)
    flags = flag_sessions(responses, rules, expected=expected)
    words = (
        f"{int(flags['flagged'].sum())} of {len(flags)} sessions flagged by the rules "
        f"“{rules.name}” and left out"
    )
    return without_flagged(responses, flags), {"Exclusions": words}


def _asked(rested: pd.DataFrame, dropped: pd.DataFrame) -> pd.Series:
    """How many stimuli a whole submission would have, by scenario.

    What people saw: what a model answered of it and what it lacks. Without people: what all files
    name together.
    """
    keys = ["file", "agent", "scenario"]
    lacking = dropped[dropped["reason"] == NOT_PREDICTED].groupby(keys)["stimuli"].sum()
    seen = rested.groupby(keys)["stimulus"].nunique().add(lacking, fill_value=0)
    named = rested.groupby("scenario")["stimulus"].nunique()
    most = pd.concat([seen.groupby("scenario").max(), named], axis=1).max(axis=1)
    return most.astype(int)


def _with_asked(table: pd.DataFrame, asked: pd.Series, scenario: str) -> pd.DataFrame:
    """``of_scenarios`` and ``of_stimuli``, and a reason where a model lacks some of them."""
    whole = asked if scenario in (MEAN, POOLED) else asked[[scenario]]
    table = table.assign(of_scenarios=len(whole), of_stimuli=int(whole.sum()))
    for place, row in table.iterrows():
        if not _is_partial(row):
            continue
        over = "mean over" if scenario == MEAN else "over"
        why = f"{over} {row['scenarios']} of {len(whole)} scenarios"
        if row["scenarios"] == len(whole):
            why = f"over {row['stimuli']} of {row['of_stimuli']} stimuli"
        table.loc[place, "reason"] = "; ".join(filter(None, [why, row["reason"]]))
    return table


def _is_partial(rows: Any) -> Any:
    """Does a row, or do the rows of a table, rest on fewer stimuli than there are?"""
    return rows["stimuli"] < rows["of_stimuli"]


def sort_leaderboard(
    table: pd.DataFrame, by: str = "accuracy", ascending: bool | None = None
) -> pd.DataFrame:
    """The table sorted by any column, ``rank`` by that order, NaN last, ties by model and file.

    By a score, models that lack stimuli come after those that lack none: means over other
    scenarios do not compare. ``ascending`` None puts the best first: large scores, small RMSD,
    words by the alphabet. Raises `UnknownNameError` with the closest columns.
    """
    if by not in table.columns or by == "rank":
        raise UnknownNameError("column", by, [name for name in table.columns if name != "rank"])
    if ascending is None:
        numeric = pd.api.types.is_numeric_dtype(table[by])
        ascending = not numeric or by.removesuffix("_low").removesuffix("_high") in LOWER_IS_BETTER
    ties = [name for name in ("model", "readout", "training", "file", "agent") if name != by]
    order = table.sort_values(ties, kind="stable").sort_values(
        by, ascending=ascending, kind="stable", na_position="last"
    )
    if by.removesuffix("_low").removesuffix("_high") in (*SCORED, "kappa"):
        after = _is_partial(order).astype(int).mask(order[by].isna(), 2)
        order = order.loc[after.sort_values(kind="stable").index]
    return order.assign(rank=np.arange(1, len(order) + 1)).reset_index(drop=True)


def _read(path: Path) -> tuple[pd.DataFrame, dict[str, str]]:
    """The checked rows of a file, and for each of its models the versions that made it."""
    raw = read_csv(path, REQUIRED)
    rows = name_models(check_predictions(raw, str(path)))
    beside = sidecar_versions(path)
    if "Versions" not in raw.columns:
        return rows, dict.fromkeys(rows["agent"].unique(), beside)
    # The rows are still in the order of the file.
    words = raw["Versions"].fillna("").str.strip().reset_index(drop=True)
    found = words.groupby(rows["agent"].to_numpy()).agg(lambda each: "; ".join(sorted({*each})))
    return rows, {str(agent): text or beside for agent, text in found.items()}


def sidecar_versions(path: Path) -> str:
    """The entry ``versions`` of the JSON file beside a table of predictions; empty without one.

    The file is called as the table, with ``.json`` for or after its ending; ``versions`` is text,
    or an object of names and versions. Raises `BadInputError` where it is something else.
    """
    for beside in (path.with_suffix(".json"), path.with_name(path.name + ".json")):
        if not beside.is_file():
            continue
        try:
            content = json.loads(beside.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise BadInputError(f"{beside} is not a JSON file: {error}") from error
        versions = content.get("versions", "") if isinstance(content, dict) else None
        if isinstance(versions, dict):
            return ", ".join(f"{name} {version}" for name, version in versions.items())
        if not isinstance(versions, str):
            raise BadInputError(f"{beside}: 'versions' must be text or an object of versions")
        return versions
    return ""


def _people(
    humans: pd.DataFrame | None, labels: Mapping[str, bool] | None, test: pd.DataFrame | None
) -> tuple[pd.DataFrame | None, Mapping[str, bool] | None]:
    """People by stimulus and outcomes: those given, else those of the single answers."""
    if test is None:
        return humans, labels
    known = test.drop_duplicates("stimulus").set_index("stimulus")["label"]
    outcomes = {str(name): bool(value) for name, value in known.items()} | dict(labels or {})
    if humans is None:
        by = test.groupby(["stimulus", "scenario"], as_index=False, sort=False)
        humans = by.agg(accuracy=("correct", "mean"), count=("correct", "size"))
    return humans, outcomes


def _score(
    found: Comparison,
    rows: pd.DataFrame,
    answers: Mapping[str, Answers],
    scenario: str,
    draws: Bootstrap,
) -> pd.DataFrame:
    """One row a model of one file."""
    chosen = found.scores[found.scores["scenario"] == scenario]
    if chosen.empty:
        raise BadInputError(f"nothing of scenario {scenario!r} can be compared")
    scored = [f"{score}{end}" for score in SCORED for end in ("", "_low", "_high")]
    table = chosen[["agent", "model", "readout", "stimuli", "reason", *scored]].copy()
    counts = found.stimuli.groupby("agent")["scenario"].nunique()
    table["scenarios"] = table["agent"].map(counts) if scenario in (MEAN, POOLED) else 1
    training = rows.drop_duplicates("agent").set_index("agent")["Dynamics Training Dataset"]
    table["training"] = table["agent"].map(training)
    if not found.has_people:
        return table
    table[["kappa", "kappa_low", "kappa_high"]] = np.nan
    if answers:
        _add_kappa(table, found, answers, scenario, draws)
    else:
        table["reason"] = _also(table["reason"], KAPPA_NEEDS)
    return table


def _add_kappa(
    table: pd.DataFrame,
    found: Comparison,
    answers: Mapping[str, Answers],
    scenario: str,
    draws: Bootstrap,
) -> None:
    """Mean kappa with the participants, averaged over scenarios, drawn over participants."""
    for place, agent in table["agent"].items():
        own = found.stimuli[found.stimuli["agent"] == agent]
        names = own["scenario"].unique() if scenario in (MEAN, POOLED) else [scenario]
        if scenario == POOLED or any(name not in answers for name in names):
            why = "kappa: pooled over scenarios nobody answered all stimuli"
            if scenario != POOLED:
                why = "kappa: no answers of single participants for every scenario"
            table.loc[place, "reason"] = "; ".join(filter(None, [table["reason"][place], why]))
            continue
        values, resampled = [], []
        for name in names:
            value, drawn = _kappa(own[own["scenario"] == name], answers[name], draws)
            values.append(value)
            resampled.append(drawn)
        low, high = draws.interval(np.mean(resampled, axis=0))
        table.loc[place, ["kappa", "kappa_low", "kappa_high"]] = [np.mean(values), low, high]
        if not np.isfinite(np.mean(values)):
            why = "kappa: undefined, model and people always give the same one answer"
            table.loc[place, "reason"] = "; ".join(filter(None, [table["reason"][place], why]))


def _kappa(rows: pd.DataFrame, answers: Answers, draws: Bootstrap) -> tuple[float, Array]:
    """Mean over participants of kappa in one scenario, and that in each resample of them."""
    models, _ = models_of(rows, answers)
    pairs = cross_kappa(answers.yes, models.predicted)
    drawn = share(pairs, draws_of_people(answers, draws))
    return float(share(pairs)[0]), drawn[:, 0]


def _also(reasons: pd.Series, why: str) -> pd.Series:
    return reasons.where(reasons == "", reasons + "; ") + why


def _words(scenario: str, single: bool) -> dict[str, str]:
    words = {
        "Leaderboard": "each file by itself, on the stimuli that it shares with people; scores of "
        + (scenario if scenario in SCENARIOS else f"the row “{scenario}” over scenarios")
    }
    if single:
        words["Kappa"] = (
            "mean over participants of Cohen's kappa with the model, averaged over scenarios; its "
            "interval draws participants, those of the other scores draw stimuli"
        )
    return words
