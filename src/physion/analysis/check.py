"""Checks of files before a comparison: every fault with its row.

Rows are counted from 1 below the header. An *error* makes a comparison wrong or impossible; a
*warning* should be looked at. Names by themselves do not identify test trials: 1184 of the 1200
official test names are also names of (other) readout trials. Leakage is therefore checked with an
index of the dataset, a list of fitted stimuli, or a column ``split``.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from physion.analysis.people.exclusions import (
    PREREGISTERED,
    ExclusionRules,
    Expected,
    completeness_warnings,
    flag_sessions,
)
from physion.analysis.people.responses import Responses, check_labels, missing_times
from physion.analysis.people.results import read_any_responses
from physion.analysis.tables import DATASETS, DISTINGUISHING, PREDICTIONS, READOUTS
from physion.core.errors import BadInputError
from physion.core.names import canonical_name, is_ledge, scenario_of
from physion.core.tables import Column, inspect_table, read_csv, read_table

SHOWN = 20
"""Faults of one kind that are listed one by one; more are counted in one line."""

TESTING = ("testing", "test")
"""Names of the split that may be predicted."""

CHECKED_COLUMNS: tuple[Column, ...] = (
    *PREDICTIONS,
    Column("split", "text", "Split of the trial in its dataset", also=("Split",)),
    Column("fold", "integer", "Fold of a cross-validation; -1: none", also=("Fold",)),
)
"""What a file of predictions is checked for."""

_ALIKE = {
    "outcome": "accuracy cannot tell knowing it from always saying it",
    "predicted": "kappa and accuracy say nothing about what the model sees",
    "p_contact": "r is undefined",
}
"""Columns that should vary within a model and scenario, and the consequence if they do not."""


@dataclass(frozen=True)
class Fault:
    """A fault: ``row`` (from 1, None if it is about the file or many rows), ``stimulus`` and
    ``column`` (empty if not about one), ``level`` (error or warning).
    """

    kind: str
    message: str
    row: int | None = None
    stimulus: str = ""
    column: str = ""
    level: str = "error"

    def __str__(self) -> str:
        position = "" if self.row is None else f"row {self.row}"
        position += f" ({self.stimulus})" if self.stimulus else ""
        return f"{self.level}: {position + ': ' if position else ''}{self.message}"


@dataclass(frozen=True)
class Reference:
    """What predictions are checked against; what is None is not checked.

    - ``labels``: official outcome of every stimulus that should be predicted, by canonical name;
    - ``index``: the trials of a dataset: ``trial``, ``split``, and optionally ``digest`` (of the
      motion) and ``scene_digest``;
    - ``fitted``: canonical names of the stimuli on which the readout was fitted.

    A stimulus without a prediction is an error if all must be predicted (``complete``).
    """

    labels: Mapping[str, bool] | None = None
    index: pd.DataFrame | None = None
    fitted: Collection[str] | None = None
    complete: bool = True


@dataclass(frozen=True)
class Checked:
    """Result of a check: faults in the order of the checks, checks that were not possible and why,
    and the number of rows of each model, or of responses of ``people`` by scenario.
    """

    file: str
    rows: int
    models: Mapping[str, int]
    faults: tuple[Fault, ...]
    not_checked: tuple[str, ...] = field(default=())
    people: Mapping[str, int] = field(default_factory=dict)

    @property
    def errors(self) -> int:
        """Number of faults that forbid a comparison."""
        return sum(fault.level == "error" for fault in self.faults)


def check_predictions_file(path: Path, reference: Reference | None = None) -> Checked:
    """Check the file of predictions at ``path``.

    Raises `BadInputError` if it is no CSV table; everything else becomes a fault.
    """
    against = reference or Reference()
    # A row that ends early has no value in its last columns.
    table = read_csv(path).reset_index(drop=True).fillna("")
    typed, missing, bad = inspect_table(table, CHECKED_COLUMNS)
    faults = [
        Fault(
            "columns",
            f"column {column.name!r} is missing (or {', '.join(column.also)})",
            column=column.name,
        )
        for column in missing
    ]
    # pandas names the second of two equal columns "name.1".
    headers = {name for column in PREDICTIONS for name in (column.name, *column.also)}
    for name in map(str, table.columns):
        stem, _, number = name.rpartition(".")
        if stem in headers and number.isdigit():
            faults.append(Fault("columns", f"column {stem!r} stands twice", column=stem))
    if faults:
        # The other checks need these columns.
        return Checked(str(path), len(table), {}, tuple(faults), ("all but the columns",))
    rows = _complete(typed, path.stem)
    stimulus = rows["stimulus"]
    faults += _shorten(
        Fault(
            "value",
            f"{cell.header} holds {cell.value!r}; expected {cell.expected}",
            cell.row,
            str(stimulus.iloc[cell.row - 1]),
            cell.header,
        )
        for cell in bad
    )
    for found in (
        _against_probability(rows),
        _unknown_readouts(rows),
        _duplicates(rows),
        _alike(rows),
        _labels(rows, against.labels),
        _coverage(rows, against),
        _leaks(rows, against),
    ):
        faults += _shorten(found)
    counted = rows.groupby("row").size()
    models = {str(name): int(count) for name, count in counted.sort_index().items()}
    return Checked(str(path), len(table), models, tuple(faults), _unchecked(rows, against))


def _complete(typed: pd.DataFrame, name: str) -> pd.DataFrame:
    """Return all columns, and ``row``: model and readout as tables of results name them."""
    rows = typed.reindex(columns=[column.name for column in CHECKED_COLUMNS])
    for column in CHECKED_COLUMNS:
        if column.kind == "text":
            given = rows[column.name].astype(object)
            rows[column.name] = given.where(given.notna(), "").astype(str)
    rows["stimulus"] = rows["stimulus"].map(canonical_name)
    if "model" not in typed:
        rows["model"] = name
    rows["readout"] = rows["readout"].replace(READOUTS)
    joined = rows["model"] + " · " + rows["readout"]
    return rows.assign(row=rows["model"].where(rows["readout"] == "", joined))


def _against_probability(rows: pd.DataFrame) -> list[Fault]:
    """Warn of answers that contradict their probability."""
    p = rows["p_contact"].astype(np.float64)
    said = rows["predicted"].astype("boolean")
    against = said.notna() & p.notna() & (p != 0.5) & ((p > 0.5) != said.fillna(False))
    return [
        Fault(
            "outcome",
            f"predicts {said.iloc[row]} with a probability of contact of {p.iloc[row]:g}",
            int(row) + 1,
            str(rows["stimulus"].iloc[row]),
            "predicted",
            "warning",
        )
        for row in np.flatnonzero(against.to_numpy(dtype=bool))
    ]


def _unknown_readouts(rows: pd.DataFrame) -> list[Fault]:
    known = {*READOUTS.values(), "D", ""}
    return [
        Fault(
            "readout",
            f"readout {name!r} is none of {', '.join(READOUTS.values())}; it is compared under "
            "this name",
            column="readout",
            level="warning",
        )
        for name in sorted({*rows["readout"]} - known)
    ]


def _duplicates(rows: pd.DataFrame) -> list[Fault]:
    """Check that no model predicts a stimulus twice with one readout."""
    keys = ["row", *DISTINGUISHING, "stimulus"]
    numbers = pd.Series(np.arange(1, len(rows) + 1), index=rows.index)
    earlier = numbers.groupby([rows[key] for key in keys], sort=False).transform("first")
    return [
        Fault(
            "duplicate",
            f"the same model and readout predict this stimulus in row {earlier.iloc[row]} already",
            int(row) + 1,
            str(rows["stimulus"].iloc[row]),
            "stimulus",
        )
        for row in np.flatnonzero((earlier != numbers).to_numpy())
    ]


def _alike(rows: pd.DataFrame) -> list[Fault]:
    """Warn if all outcomes, or all answers, of a model in a scenario are the same."""
    scenario = rows["stimulus"].map(lambda name: scenario_of(name) or "an unknown scenario")
    keys = [rows[key] for key in ("row", *DISTINGUISHING)]
    found = []
    for of, own in rows.groupby([*keys, scenario.rename("on")], sort=False).groups.items():
        for column, consequence in _ALIKE.items():
            given = rows.loc[own, column].dropna()
            if len(given) > 1 and given.nunique() == 1:
                where = " · ".join(word for word in of[:-1] if word)
                text = f"{column} is {given.iloc[0]} in all {len(given)} rows of {where}, {of[-1]}"
                found.append(
                    Fault("alike", f"{text}: {consequence}", column=column, level="warning")
                )
    return found


def _labels(rows: pd.DataFrame, labels: Mapping[str, bool] | None) -> list[Fault]:
    """Check the outcomes of the file against the official ones."""
    if labels is None:
        return []
    official = rows["stimulus"].map(dict(labels)).astype("boolean")
    recorded, shown = (rows[name].astype("boolean") for name in ("recorded_outcome", "outcome"))
    wrong = (recorded != official).fillna(False).to_numpy(dtype=bool)
    faults = [
        Fault(
            "label",
            f"recorded_outcome is {recorded.iloc[row]}, and the official outcome is not",
            int(row) + 1,
            str(rows["stimulus"].iloc[row]),
            "recorded_outcome",
        )
        for row in np.flatnonzero(wrong)
    ]
    changed = int((shown != official).fillna(False).sum())
    if changed:
        faults.append(
            Fault(
                "label",
                f"the outcome of the trial shown is not the official one in {changed} rows; the "
                "official one is compared with",
                column="outcome",
                level="warning",
            )
        )
    return faults


def _coverage(rows: pd.DataFrame, against: Reference) -> list[Fault]:
    """Find unknown stimuli, and known ones without a prediction."""
    wanted: set[str] = set(against.labels or ())
    trials: set[str] = set()
    if against.index is not None:
        names = against.index["trial"].map(canonical_name)
        trials = set(names)
        if not wanted:
            wanted = set(names[against.index["split"].isin(TESTING)])
    if not wanted and not trials:
        return []
    faults = []
    for row in np.flatnonzero(~rows["stimulus"].isin(wanted | trials).to_numpy()):
        name = str(rows["stimulus"].iloc[row])
        # Models of the study were also tested on trials that no person saw.
        official = against.labels is not None and scenario_of(name) is not None
        message = "people did not see it: it is not compared" if official else "no such stimulus"
        level = "warning" if official else "error"
        faults.append(Fault("unknown", message, int(row) + 1, name, "stimulus", level))
    return faults + _missing(rows, wanted, against)


def _missing(rows: pd.DataFrame, wanted: set[str], against: Reference) -> list[Fault]:
    scenario = _scenario_by_name(wanted, against)
    faults = []
    keys = [rows[key] for key in ("row", *(d for d in DISTINGUISHING if d not in DATASETS))]
    for (model, *_), stimuli in rows["stimulus"].groupby(keys, sort=False):
        given = set(stimuli)
        absent: dict[str, list[str]] = {}
        for name in sorted(wanted - given):
            absent.setdefault(scenario[name], []).append(name)
        for where, names in absent.items():
            whole = not any(scenario.get(name) == where for name in given)
            ledges = all(map(is_ledge, names))
            what = f"no stimulus of {where}" if whole else f"{len(names)} stimuli of {where} lack"
            what += "" if whole else f" a prediction, the first is {names[0]}"
            what += " (Roll's ledges, which are not compared)" if ledges else ""
            level = "warning" if whole or ledges or not against.complete else "error"
            faults.append(Fault("missing", f"{model}: {what}", column="stimulus", level=level))
    return faults


def _scenario_by_name(names: set[str], against: Reference) -> dict[str, str]:
    result: dict[str, str] = {}
    if against.index is not None and "scenario" in against.index.columns:
        trials = against.index["trial"].map(canonical_name)
        result = dict(zip(trials, against.index["scenario"].astype(str), strict=True))
    return {name: result.get(name) or scenario_of(name) or "no known scenario" for name in names}


def _leaks(rows: pd.DataFrame, against: Reference) -> list[Fault]:
    """Find stimuli on which a readout or a model may have been fitted."""
    stimulus = rows["stimulus"]
    split = rows["split"].str.lower()
    reason = pd.Series("", index=rows.index, dtype=object)
    reason = reason.mask(~split.isin(["", *TESTING]), "column split says it is not a test trial")
    if against.fitted is not None:
        on = stimulus.isin({canonical_name(name) for name in against.fitted})
        reason = reason.mask(on, "the readout was fitted on it")
    copies: list[Fault] = []
    if against.index is not None:
        names = against.index.assign(name=against.index["trial"].map(canonical_name))
        of = stimulus.map(names.drop_duplicates("name").set_index("name")["split"].astype(str))
        other = of.notna() & ~of.isin(TESTING)
        reason = reason.mask(other, "in the dataset it is a trial of the split " + of.fillna(""))
        copies = _twins(stimulus, against.index)
    # A readout that was fitted on the other folds of the set did not see its own fold.
    cross_fitted = rows["fold"].astype("Int64").fillna(-1) >= 0
    reason = reason.mask(cross_fitted, "")
    result = [
        _leak(str(reason.iloc[row]), int(row), stimulus)
        for row in np.flatnonzero((reason != "").to_numpy())
    ]
    return result + copies


def _leak(message: str, row: int, stimulus: pd.Series) -> Fault:
    return Fault("leak", message, row + 1, str(stimulus.iloc[row]), "stimulus")


def _twins(stimulus: pd.Series, index: pd.DataFrame) -> list[Fault]:
    """Find test trials whose scene or motion also occurs in another split."""
    faults = []
    seen = index["trial"].map(canonical_name).isin(set(stimulus))
    testing = index[index["split"].isin(TESTING) & seen]
    others = index[~index["split"].isin(TESTING)]
    for column, what in (("digest", "motion"), ("scene_digest", "scene")):
        if column not in index.columns:
            continue
        of = others.dropna(subset=[column]).drop_duplicates(column).set_index(column)["trial"]
        for trial, value in zip(testing["trial"], testing[column], strict=True):
            if isinstance(value, str) and value and value in of.index:
                name = canonical_name(str(trial))
                row = int(np.flatnonzero((stimulus == name).to_numpy())[0])
                message = f"trial {of[value]!r} of another split has the same {what}"
                faults.append(_leak(message, row, stimulus))
    return faults


def _shorten(faults: Iterable[Fault]) -> list[Fault]:
    """Return at most `SHOWN` faults of one kind, level and column, and the others as a count."""
    kept: list[Fault] = []
    counts: dict[tuple[str, str, str], int] = {}
    for fault in faults:
        key = (fault.kind, fault.level, fault.column)
        counts[key] = counts.get(key, 0) + 1
        if counts[key] <= SHOWN:
            kept.append(fault)
    for (kind, level, column), count in counts.items():
        if count > SHOWN:
            more = f"{count - SHOWN} more of this kind ({kind}{', ' + column if column else ''})"
            kept.append(Fault(kind, more, column=column, level=level))
    return kept


def read_index(path: Path) -> pd.DataFrame:
    """Read an index of trials (parquet or CSV) with at least ``trial`` and ``split``."""
    file = path / "index.parquet" if path.is_dir() else path
    return read_table(file, ("trial", "split"))


def _unchecked(rows: pd.DataFrame, against: Reference) -> tuple[str, ...]:
    """Return what could not be checked, as text."""
    left = []
    if against.labels is None and against.index is None:
        left.append("whether the stimuli are known and all there: no list of them was given")
    if against.labels is None:
        left.append("recorded outcomes: no official outcomes were given")
    if against.index is None and against.fitted is None and (rows["split"] == "").all():
        left.append("leakage of splits: no index, no list of fitted stimuli, no column split")
    return tuple(left)


# Answers of single participants: errors that stop an analysis, and what it would leave out.

FEWEST_PEOPLE = 2
"""People a stimulus, below which neither kappa of two people nor a noise ceiling is defined."""


def check_responses(
    files: Sequence[Path],
    sessions: Path | None = None,
    labels: Mapping[str, bool] | None = None,
    expected: Expected | None = None,
    rules: ExclusionRules = PREREGISTERED,
) -> tuple[Checked, Responses | None]:
    """Check the answers of single participants.

    Parameters
    ----------
    files, sessions
        As for `read_any_responses`.
    labels
        Official outcomes, with which the labels of the responses must agree; None: not checked.
    expected
        Stimuli that a session must have, as for `flag_sessions`.
    rules
        Exclusion rules, whose flags are counted.

    Returns
    -------
    checked
        An error for what stops an analysis, with file, row and column where they are known; a
        warning for each kind of answers or sessions that would be left out, for answers without a
        response time and for stimuli with fewer than `FEWEST_PEOPLE` answers.
    responses
        What was read; None after an error.
    """
    name = ", ".join(map(str, files))
    try:
        responses = read_any_responses(files, sessions)
        if labels is not None:
            check_labels(responses, labels)
    except BadInputError as error:
        return Checked(name, 0, {}, (Fault("responses", str(error)),)), None
    faults = [_warning(text) for text in completeness_warnings(responses, expected)]
    for table in (responses.dropped, missing_times(responses)):
        faults += [
            _warning(f"{row['scenario']}: {row['rows']} answers of {row['sessions']} sessions: "
                     f"{row['reason']}")
            for row in table.to_dict("records")
        ]  # fmt: skip
    flags = flag_sessions(responses, rules, expected=expected)
    if flags["flagged"].any():
        faults.append(
            _warning(
                f"{int(flags['flagged'].sum())} of {len(flags)} sessions are flagged by the rules "
                f"“{rules.name}” and would be left out"
            )
        )
    faults += _few_answers(responses.test)
    counts = responses.test.groupby("scenario")["session"].nunique()
    people = {str(scenario): int(n) for scenario, n in counts.items()}
    unchecked = () if labels is not None else ("outcomes: no official outcomes were given",)
    checked = Checked(name, len(responses.trials), {}, tuple(faults), unchecked, people)
    return checked, responses


def _warning(text: str) -> Fault:
    return Fault("responses", text, level="warning")


def _few_answers(test: pd.DataFrame) -> list[Fault]:
    counts = test.groupby("stimulus").size()
    few = counts[counts < FEWEST_PEOPLE]
    if few.empty:
        return []
    text = f"{len(few)} stimuli have fewer than {FEWEST_PEOPLE} answers, such as {few.index[0]}"
    return [_warning(text)]
