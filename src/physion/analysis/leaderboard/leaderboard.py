"""Leaderboard: one table of many prediction files with accuracy, similarity to people and versions.

Each file is compared separately, on the stimuli that people saw and it predicts, so that files made
on different sets of trials can be in one table; the column ``stimuli`` counts them. A file that
cannot be compared is listed in `Leaderboard.refused` with the reason. A model that lacks stimuli
ranks after those that lack none, whatever its scores. Models that see the whole movie, and anchors
of the files, follow the models without a rank.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from physion.analysis.leaderboard.order import (
    add_normalised,
    columns,
    required_stimuli,
    sort_leaderboard,
    with_required,
)
from physion.analysis.leaderboard.ranks import COLUMNS as RANK_COLUMNS
from physion.analysis.leaderboard.ranks import KEY, rank_intervals
from physion.analysis.leaderboard.rows import score_anchors, score_models
from physion.analysis.leaderboard.submissions import Filters, Submission, read_submission
from physion.analysis.metrics import leaderboard_metrics
from physion.analysis.models.anchors import anchor_scores
from physion.analysis.models.comparison import compare_scores
from physion.analysis.models.contradictions import check_coverage
from physion.analysis.models.observed_contact import observed_contacts
from physion.analysis.people.answers import ScenarioAnswers
from physion.analysis.people.completeness import (
    Expected,
    check_expected,
    completeness_warnings,
    drop_unexpected,
)
from physion.analysis.people.exclusions import (
    PREREGISTERED,
    ExclusionRules,
    check_excluded,
    describe_confirmed,
    flag_sessions,
    without_flagged,
)
from physion.analysis.people.participants import REHEARSAL, Responses, check_labels
from physion.analysis.people.people import all_answers
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.tables.stimuli import MEAN, POOLED, check_excluded_names
from physion.core.errors import BadInputError, UnknownNameError
from physion.core.names import SCENARIOS


@dataclass(frozen=True)
class Leaderboard:
    """Ranked table of models.

    - ``table``: the models of the files, and the anchors among them; see
      `order.columns`.
    - ``anchors``: people and the anchors that are computed on the stimuli of all files
      (`anchors.COMPUTED`), with the same columns; no file contains them. Empty without people.
    - ``by_scenario``: one row a model, or anchor, and scenario: ``file``, ``agent``, ``scenario``,
      ``stimuli`` and the metrics that need no single answers, with intervals.
    - ``dropped``: what was left out of each file: ``file``, ``agent``, ``scenario``, ``reason``,
      ``stimuli``.
    - ``refused``: files that could not be compared: ``file``, ``reason``.
    - ``dropped_answers``: excluded answers of people (`Responses.dropped`); None without single
      answers.
    - ``settings``: the settings as text, by name.
    - ``warnings``: what may make the scores wrong, one sentence each.
    - ``mark``: what must stand at the top of its page: `REHEARSAL` for simulated participants.
    """

    table: pd.DataFrame
    anchors: pd.DataFrame
    by_scenario: pd.DataFrame
    dropped: pd.DataFrame
    refused: pd.DataFrame
    dropped_answers: pd.DataFrame | None
    settings: Mapping[str, str]
    warnings: tuple[str, ...] = ()
    mark: str = ""


def leaderboard(
    files: Sequence[Path],
    humans: pd.DataFrame | None = None,
    labels: Mapping[str, bool] | None = None,
    responses: Responses | None = None,
    *,
    rules: ExclusionRules = PREREGISTERED,
    expected: Expected | None = None,
    accept_rules: Collection[str] = (),
    scenario: str = MEAN,
    exclude: Iterable[str] = (),
    exclude_ledge: bool = True,
    later: bool = False,
    filters: Filters | None = None,
    complete: bool = False,
    by: str = "accuracy",
    ascending: bool | None = None,
    bootstrap: Bootstrap | None = None,
) -> Leaderboard:
    """Score every model of every file, best first (`sort_leaderboard`).

    Parameters
    ----------
    files
        CSV files of predictions.
    humans, labels, exclude, exclude_ledge
        As in `comparison.compare`.
    responses
        Answers of single participants; the sessions that ``rules`` flag are left out. They give
        kappa and, if ``humans`` is None, replace it.
    rules, expected, accept_rules
        As in `people.results.analyse_people`.
    scenario
        One of the eight, *mean* (with equal weights) or *pooled*.
    later
        Whether to exclude the trials whose contact was observed, or not known to be observed or
        not (`observed_contact`).
    filters
        Which models are on the leaderboard; None: all.
    complete
        Whether to leave out models that lack stimuli.
    by, ascending
        As in `sort_leaderboard`. The uncertainty of ranks is given for metrics.
    bootstrap
        Level of the intervals, and draws for the uncertainty of ranks.

    Raises
    ------
    BadInputError
        If no file is given or none can be compared, no model passes the filters, no session is
        left, the outcomes of the responses contradict ``labels``, or ``later`` is asked of files
        that do not contain it.
    UnknownNameError
        For a name in ``exclude`` that no table contains.
    """
    if not files:
        raise BadInputError("no file of predictions was given")
    if scenario not in (*SCENARIOS, MEAN, POOLED):
        raise UnknownNameError("scenario", scenario, (*SCENARIOS, MEAN, POOLED))
    draws, exclude = bootstrap or Bootstrap(), tuple(exclude)
    kept, flagging = _unflagged(responses, rules, expected, accept_rules, labels)
    test = None if kept is None else kept.test
    people, outcomes = _people(humans, labels, test)
    answers = {} if test is None else {each.scenario: each for each in all_answers(test)}
    read, refused = _read(files)
    known = set() if people is None else set(people["stimulus"])
    known |= {name for one in read.values() for name in one.rows["stimulus"]} | set(outcomes or {})
    if read:
        check_excluded_names(exclude, known)
    mark = REHEARSAL if responses is not None and responses.simulated_sessions else ""
    warnings = [mark] if mark else []
    warnings += [] if responses is None else completeness_warnings(responses, expected)
    if humans is not None and labels is not None:
        warnings += check_coverage(humans, labels)
    unwanted = (*exclude, *(_not_later(read) if later else ()))
    chosen = _filtered(read, filters)
    tables, dropped, answered, scenarios = [], [], [], []
    settings: Mapping[str, str] = {}
    for path, submission in chosen.items():
        try:
            comparison = compare_scores(
                submission.rows,
                people,
                outcomes,
                exclude=unwanted,
                exclude_ledge=exclude_ledge,
                bootstrap=draws,
            )
            scored = score_models(comparison, submission.rows, answers, scenario, draws.level)
        except BadInputError as error:
            refused[path] = str(error)
            continue
        tables.append(
            scored.assign(
                file=str(path),
                versions=scored["agent"].map(submission.versions),
                license=submission.license,
                sha256=submission.sha256,
            )
        )
        scenarios.append(_by_scenario(comparison.scores, str(path)))
        dropped.append(comparison.dropped.assign(file=str(path)))
        answered.append(comparison.stimuli.assign(file=str(path)))
        warnings += [f"{path}: {text}" for text in comparison.warnings]
        settings = comparison.settings
    if not tables:
        raise BadInputError(f"no file can be compared: {next(refused[path] for path in files)}")
    left_out, stimuli = pd.concat(dropped, ignore_index=True), pd.concat(answered)
    anchors = score_anchors(stimuli, answers, scenario, draws.level)
    required = required_stimuli(stimuli, left_out)
    table = with_required(pd.concat(tables, ignore_index=True), required, scenario)
    table = add_normalised(table, anchors)
    if complete:
        table = table[table["stimuli"] == table["of_stimuli"]].reset_index(drop=True)
    table = _with_rank_intervals(table, stimuli, answers, by, scenario, draws)
    scenarios.append(_by_scenario(anchor_scores(stimuli, draws.level), ""))
    order = ["file", "agent", "scenario", "reason", "stimuli"]
    return Leaderboard(
        sort_leaderboard(table.reindex(columns=columns()), by, ascending),
        with_required(anchors, required, scenario).reindex(columns=columns()),
        pd.concat(scenarios, ignore_index=True),
        left_out[order],
        pd.DataFrame(
            [(str(path), refused[path]) for path in files if path in refused],
            columns=["file", "reason"],
        ),
        None if kept is None else kept.dropped,
        {**settings, **_describe_scores(scenario, test is not None), **flagging},
        tuple(warnings),
        mark,
    )


def _with_rank_intervals(
    table: pd.DataFrame,
    stimuli: pd.DataFrame,
    answers: Mapping[str, ScenarioAnswers],
    by: str,
    scenario: str,
    draws: Bootstrap,
) -> pd.DataFrame:
    """Add the uncertainty of the ranks of complete models, if they are ranked by a metric."""
    metric = next((one for one in leaderboard_metrics() if one.name == by), None)
    whole = (table["kind"] == "model") & (table["stimuli"] == table["of_stimuli"])
    if (
        metric is None
        or not whole.any()
        or (metric.needs != "outcome" and not _has_people(stimuli))
    ):
        return table.assign(**dict.fromkeys(RANK_COLUMNS, np.nan))
    ranked = stimuli.merge(table.loc[whole, KEY], on=KEY)
    return table.merge(rank_intervals(ranked, answers, metric, scenario, draws), on=KEY, how="left")


def _has_people(stimuli: pd.DataFrame) -> bool:
    return bool(stimuli["p_yes"].notna().any())


def _by_scenario(scores: pd.DataFrame, file: str) -> pd.DataFrame:
    """Return the rows of single scenarios with the metrics of the leaderboard."""
    if scores.empty:
        return pd.DataFrame()
    named = [one.name for one in leaderboard_metrics() if one.in_scores]
    bounds = [f"{name}{end}" for name in named for end in ("", "_low", "_high")]
    rows = scores[~scores["scenario"].isin((MEAN, POOLED))].assign(file=file)
    return rows[["file", "agent", "kind", "scenario", "stimuli", *bounds]]


def _filtered(read: Mapping[Path, Submission], filters: Filters | None) -> dict[Path, Submission]:
    """Return the submissions with the chosen models, without those that have none."""
    if filters is None or not read:
        return dict(read)
    chosen = {path: filters.apply(submission) for path, submission in read.items()}
    left = {path: submission for path, submission in chosen.items() if len(submission.rows)}
    if not left:
        raise BadInputError(
            "no model passes the filters; names are in the columns Model, Readout Type and "
            "Dynamics Training Dataset of the files"
        )
    return left


def _read(files: Sequence[Path]) -> tuple[dict[Path, Submission], dict[Path, str]]:
    """Return the checked submission of each file, and why others were refused."""
    read, refused = {}, {}
    for path in files:
        try:
            read[path] = read_submission(path)
        except BadInputError as error:
            refused[path] = str(error)
    return read, refused


def _not_later(read: Mapping[Path, Submission]) -> list[str]:
    """Return the stimuli whose contact was observed, or not known to be observed or not."""
    if not read:
        return []
    rows = pd.concat([one.rows for one in read.values()], ignore_index=True)
    known = observed_contacts(rows)
    if known.empty:
        raise BadInputError(
            "which contacts were observed is not known: no file has a column Observed Contact"
        )
    return sorted(set(rows["stimulus"]) - set(known.index[~known]))


def _unflagged(
    responses: Responses | None,
    rules: ExclusionRules,
    expected: Expected | None,
    accept_rules: Collection[str],
    labels: Mapping[str, bool] | None,
) -> tuple[Responses | None, dict[str, str]]:
    """Return the responses without flagged sessions, and the rules as text."""
    if responses is None:
        return None, {}
    if labels is not None:
        check_labels(responses, labels)
    check_expected(responses, expected)
    flags = flag_sessions(responses, rules, expected=expected)
    check_excluded(flags, accept_rules)
    words = (
        f"{int(flags['flagged'].sum())} of {len(flags)} sessions flagged by the rules "
        f"“{rules.name}” and left out"
    )
    kept = without_flagged(drop_unexpected(responses, expected), flags)
    confirmed = describe_confirmed(flags, accept_rules)
    return kept, {"Exclusions": words} | ({"Rules confirmed": confirmed} if confirmed else {})


def _people(
    humans: pd.DataFrame | None, labels: Mapping[str, bool] | None, test: pd.DataFrame | None
) -> tuple[pd.DataFrame | None, Mapping[str, bool] | None]:
    """Return people by stimulus and outcomes: those given, else those of the single answers."""
    if test is None:
        return humans, labels
    known = test.drop_duplicates("stimulus").set_index("stimulus")["label"]
    outcomes = {str(name): bool(value) for name, value in known.items()} | dict(labels or {})
    if humans is None:
        by = test.groupby(["stimulus", "scenario"], as_index=False, sort=False)
        humans = by.agg(accuracy=("correct", "mean"), count=("correct", "size"))
    return humans, outcomes


def _describe_scores(scenario: str, single: bool) -> dict[str, str]:
    descriptions = {
        "Ranks": "by the column sorted by; equal scores have the same rank, and models that lack "
        "stimuli rank after those that lack none. Beside it the 95 % interval of the rank, for "
        "other stimuli and, where their single answers are known, other people: 1 + the models "
        "that are significantly better, to those that may be better",
        "Normalised scores": "r of its ceiling: r divided by the expected r of a model that knows "
        "the true fractions of yes; kappa of people's: kappa from averages divided by that of one "
        "person with another",
        "Readout full": "sees the whole movie, so it detects and need not predict: no rank",
        "Leaderboard": "each file by itself, on the stimuli that it shares with people; scores of "
        + (scenario if scenario in SCENARIOS else f"the row “{scenario}” over scenarios"),
    }
    if single:
        descriptions["Kappa"] = (
            "mean over participants of Cohen's kappa with the model, averaged over scenarios; its "
            "interval is about other participants, those of the other scores about other stimuli"
        )
    return descriptions
