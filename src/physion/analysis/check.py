"""Validation of a file of predictions: every fault with its row.

Rows are counted from 1 below the header. An *error* makes a comparison wrong or impossible; a
*warning* should be checked.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
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
from physion.analysis.tables import (
    DATASETS,
    DISTINGUISHING,
    READOUTS,
    REQUIRED,
    read_csv,
    read_table,
)
from physion.core.errors import BadInputError
from physion.core.names import canonical_name, is_ledge, scenario_of

# Checks of a file of predictions that need the file alone.

SUM_TOLERANCE = 1e-3
"""Largest difference of the sum of the two probabilities from 1, for rounding to three decimals."""

SHOWN = 20
"""Faults of one kind that are listed one by one; more are counted in one line."""

_WORDS = {"true": True, "1": True, "1.0": True, "yes": True,
          "false": False, "0": False, "0.0": False, "no": False}  # fmt: skip


_ALIKE = {
    "Actual Outcome": "accuracy cannot tell knowing it from always saying it",
    "Predicted Outcome": "kappa and accuracy say nothing about what the model sees",
    "Predicted Prob_true": "r is undefined",
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


def columns(table: pd.DataFrame) -> list[Fault]:
    """Check that the required columns exist once."""
    faults = [
        Fault("columns", f"column {name!r} is missing", column=name)
        for name in REQUIRED
        if name not in table.columns
    ]
    # pandas names the second of two equal columns "name.1".
    for name in table.columns:
        stem = str(name).rpartition(".")[0]
        if stem in REQUIRED and str(name).rpartition(".")[2].isdigit():
            faults.append(Fault("columns", f"column {stem!r} stands twice", column=stem))
    return faults


def each(
    bad: pd.Series, table: pd.DataFrame, stimulus: pd.Series, kind: str, column: str, expected: str
) -> list[Fault]:
    """Return one fault for each row where ``bad`` is True."""
    return [
        Fault(
            kind,
            f"{column} holds {table[column].iloc[row]!r}; expected {expected}",
            int(row) + 1,
            str(stimulus.iloc[row]),
            column,
        )
        for row in np.flatnonzero(bad.to_numpy())
    ]


def blank(table: pd.DataFrame, stimulus: pd.Series) -> list[Fault]:
    """Check that models, readouts and stimuli have names."""
    faults = []
    for column in ("Model", "Readout Type", "Stimulus Name"):
        empty = table[column].str.strip() == ""
        faults += each(empty, table, stimulus, "blank", column, "a name")
    return faults


def probabilities(table: pd.DataFrame, stimulus: pd.Series) -> list[Fault]:
    """Check that probabilities lie in 0..1 and sum to 1."""
    faults: list[Fault] = []
    values = {}
    for column in ("Predicted Prob_true", "Predicted Prob_false"):
        if column in table.columns:
            numbers = pd.to_numeric(table[column], errors="coerce")
            bad = ~numbers.between(0, 1)
            faults += each(bad, table, stimulus, "probability", column, "a number from 0 to 1")
            values[column] = numbers.where(~bad)
    if len(values) == 2:
        total = values["Predicted Prob_true"] + values["Predicted Prob_false"]
        off = (total - 1).abs() > SUM_TOLERANCE + 1e-12
        faults += [
            Fault(
                "probability",
                f"Predicted Prob_true and Predicted Prob_false sum to {total.iloc[row]:.6g}, not 1",
                int(row) + 1,
                str(stimulus.iloc[row]),
                "Predicted Prob_true",
            )
            for row in np.flatnonzero(off.to_numpy())
        ]
    return faults


def booleans(values: pd.Series) -> pd.Series:
    """Return True, False, or None for any other text."""
    return values.str.strip().str.lower().map(_WORDS).astype(object)


def outcomes(table: pd.DataFrame, stimulus: pd.Series) -> list[Fault]:
    """Check that outcomes are True or False and agree with the probability."""
    faults: list[Fault] = []
    for column in ("Predicted Outcome", "Actual Outcome"):
        bad = booleans(table[column]).isna()
        faults += each(bad, table, stimulus, "outcome", column, "True or False")
    for column in ("Recorded Outcome", "Observed Contact"):
        if column in table.columns:
            bad = booleans(table[column]).isna() & (table[column].str.strip() != "")
            faults += each(bad, table, stimulus, "outcome", column, "True, False or nothing")
    p = pd.to_numeric(table["Predicted Prob_true"], errors="coerce")
    predicted = booleans(table["Predicted Outcome"])
    against = predicted.notna() & (p != 0.5) & p.between(0, 1) & ((p > 0.5) != (predicted == True))  # noqa: E712
    faults += [
        Fault(
            "outcome",
            f"predicts {predicted.iloc[row]} with a probability of contact of {p.iloc[row]:g}",
            int(row) + 1,
            str(stimulus.iloc[row]),
            "Predicted Outcome",
            "warning",
        )
        for row in np.flatnonzero(against.to_numpy())
    ]
    return faults


def readouts(table: pd.DataFrame) -> list[Fault]:
    """Warn of readouts with other than the official names."""
    known = {*READOUTS, *READOUTS.values(), "D"}
    unknown = sorted({*table["Readout Type"].str.strip()} - known - {""})
    return [
        Fault(
            "readout",
            f"readout {name!r} is none of {', '.join(READOUTS)} ({', '.join(READOUTS.values())}); "
            "it is compared under this name",
            column="Readout Type",
            level="warning",
        )
        for name in unknown
    ]


def duplicates(table: pd.DataFrame, stimulus: pd.Series) -> list[Fault]:
    """Check that no model predicts a stimulus twice with one readout."""
    named = [name for name in DISTINGUISHING if name in table.columns]
    key = table[["Model", "Readout Type", *named]].assign(stimulus=stimulus)
    first = key.groupby(list(key.columns), sort=False).cumcount() == 0
    numbers = pd.Series(np.arange(1, len(table) + 1), index=table.index)
    earlier = numbers.groupby([key[name] for name in key.columns], sort=False).transform("first")
    return [
        Fault(
            "duplicate",
            f"the same model and readout predict this stimulus in row {earlier.iloc[row]} already",
            int(row) + 1,
            str(stimulus.iloc[row]),
            "Stimulus Name",
        )
        for row in np.flatnonzero(~first.to_numpy())
    ]


def alike(table: pd.DataFrame, stimulus: pd.Series) -> list[Fault]:
    """Warn if all outcomes, or all answers, of a model in a scenario are the same.

    Invalid values and single rows are left to the other checks.
    """
    values = {
        "Actual Outcome": booleans(table["Actual Outcome"]),
        "Predicted Outcome": booleans(table["Predicted Outcome"]),
        "Predicted Prob_true": pd.to_numeric(table["Predicted Prob_true"], errors="coerce"),
    }
    named = [name for name in DISTINGUISHING if name in table.columns]
    keys = [table[name] for name in ("Model", "Readout Type", *named)]
    scenario = stimulus.map(lambda name: scenario_of(name) or "an unknown scenario").rename("on")
    found = []
    for of, own in table.groupby([*keys, scenario], sort=False).groups.items():
        for column, consequence in _ALIKE.items():
            given = values[column].loc[own].dropna()
            if len(given) > 1 and given.nunique() == 1:
                readout = READOUTS.get(of[1], of[1])
                where = " · ".join([of[0], readout, *(word for word in of[2:-1] if word)])
                text = f"{column} is {given.iloc[0]} in all {len(given)} rows of {where}, {of[-1]}"
                found.append(
                    Fault("alike", f"{text}: {consequence}", column=column, level="warning")
                )
    return found


def shorten(faults: list[Fault]) -> list[Fault]:
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


# Checks of the trials that a file predicts: known, complete, and test trials only.
#
# Names alone do not identify test trials: 1184 of the 1200 official test names are also names of
# (other) readout trials. Leakage is therefore checked with an index of the dataset, a list of
# fitted stimuli, or a column ``Split``.

TESTING = ("testing", "test")
"""Names of the split that may be predicted."""


@dataclass(frozen=True)
class Reference:
    """What a submission is checked against; what is None is not checked.

    - ``labels``: official outcome of every stimulus that should be predicted, by canonical name;
    - ``index``: the trials of a dataset: ``trial``, ``split``, and optionally ``digest`` (of the
      motion) and ``scene_digest``;
    - ``fitted``: canonical names of the stimuli on which the readout was fitted.
    """

    labels: Mapping[str, bool] | None = None
    index: pd.DataFrame | None = None
    fitted: Collection[str] | None = None


def labels(
    table: pd.DataFrame, stimulus: pd.Series, labels: Mapping[str, bool] | None
) -> list[Fault]:
    """Check the outcomes of the file against the official ones."""
    if labels is None:
        return []
    official = stimulus.map(dict(labels)).astype(object)
    faults: list[Fault] = []
    if "Recorded Outcome" in table.columns:
        recorded = booleans(table["Recorded Outcome"])
        wrong = recorded.notna() & official.notna() & (recorded != official)
        faults += each(wrong, table, stimulus, "label", "Recorded Outcome", "the official outcome")
    shown = booleans(table["Actual Outcome"])
    changed = int((shown.notna() & official.notna() & (shown != official)).sum())
    if changed:
        faults.append(
            Fault(
                "label",
                f"the outcome of the trial shown is not the official one in {changed} rows; the "
                "official one is compared with",
                column="Actual Outcome",
                level="warning",
            )
        )
    return faults


def coverage(table: pd.DataFrame, stimulus: pd.Series, against: Reference) -> list[Fault]:
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
    for row in np.flatnonzero(~stimulus.isin(wanted | trials).to_numpy()):
        name = str(stimulus.iloc[row])
        # Models of the study were also tested on trials that no person saw.
        official = against.labels is not None and scenario_of(name) is not None
        message = "people did not see it: it is not compared" if official else "no such stimulus"
        level = "warning" if official else "error"
        faults.append(Fault("unknown", message, int(row) + 1, name, "Stimulus Name", level))
    return faults + _missing(table, stimulus, wanted, against)


def _missing(
    table: pd.DataFrame, stimulus: pd.Series, wanted: set[str], against: Reference
) -> list[Fault]:
    scenario = _scenario_by_name(wanted, against)
    faults = []
    apart = [name for name in DISTINGUISHING if name in table.columns and name not in DATASETS]
    keys = [table[name] for name in ("Model", "Readout Type", *apart)]
    for (model, readout, *_), rows in stimulus.groupby(keys, sort=False):
        given = set(rows)
        absent: dict[str, list[str]] = {}
        for name in sorted(wanted - given):
            absent.setdefault(scenario[name], []).append(name)
        for where, names in absent.items():
            whole = not any(scenario.get(name) == where for name in given)
            ledges = all(map(is_ledge, names))
            what = f"no stimulus of {where}" if whole else f"{len(names)} stimuli of {where} lack"
            what += "" if whole else f" a prediction, the first is {names[0]}"
            what += " (Roll's ledges, which are not compared)" if ledges else ""
            level = "warning" if whole or ledges else "error"
            message = f"{model} · {READOUTS.get(readout, readout)}: {what}"
            faults.append(Fault("missing", message, column="Stimulus Name", level=level))
    return faults


def _scenario_by_name(names: set[str], against: Reference) -> dict[str, str]:
    result: dict[str, str] = {}
    if against.index is not None and "scenario" in against.index.columns:
        trials = against.index["trial"].map(canonical_name)
        result = dict(zip(trials, against.index["scenario"].astype(str), strict=True))
    return {name: result.get(name) or scenario_of(name) or "no known scenario" for name in names}


def leaks(table: pd.DataFrame, stimulus: pd.Series, against: Reference) -> list[Fault]:
    """Find stimuli on which a readout or a model may have been fitted."""
    reason = pd.Series("", index=table.index, dtype=object)
    if "Split" in table.columns:
        split = table["Split"].str.strip().str.lower()
        reason = reason.mask(~split.isin(["", *TESTING]), "column Split says it is no test trial")
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
    reason = reason.mask(_cross_fitted(table), "")
    result = [
        _leak(str(reason.iloc[row]), int(row), stimulus)
        for row in np.flatnonzero((reason != "").to_numpy())
    ]
    return result + copies


def _leak(message: str, row: int, stimulus: pd.Series) -> Fault:
    return Fault("leak", message, row + 1, str(stimulus.iloc[row]), "Stimulus Name")


def _cross_fitted(table: pd.DataFrame) -> pd.Series:
    """Return rows whose readout was fitted on other folds of the set (``Fold`` >= 0)."""
    if "Fold" not in table.columns:
        return pd.Series(False, index=table.index)
    return pd.to_numeric(table["Fold"], errors="coerce").fillna(-1) >= 0


def _twins(stimulus: pd.Series, index: pd.DataFrame) -> list[Fault]:
    """Find test trials whose scene or motion equals that of a trial of another split."""
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


__all__ = ["Checked", "Fault", "Reference", "read_index", "validate"]


@dataclass(frozen=True)
class Checked:
    """Result of `validate`: faults in the order of the checks, checks that were not possible and
    why, and the number of rows of each model, or of responses of ``people`` by scenario.
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


def validate(path: Path, reference: Reference | None = None) -> Checked:
    """Check the file of predictions at ``path``.

    Raises `BadInputError` if it is no CSV table; everything else becomes a fault.
    """
    against = reference or Reference()
    # A row that ends early has no value in its last columns.
    table = read_csv(path, ()).reset_index(drop=True).fillna("")
    faults = columns(table)
    if faults:
        # The other checks need these columns.
        return Checked(str(path), len(table), {}, tuple(faults), ("all but the columns",))
    stimulus = table["Stimulus Name"].map(canonical_name)
    for found in (
        blank(table, stimulus),
        probabilities(table, stimulus),
        outcomes(table, stimulus),
        readouts(table),
        duplicates(table, stimulus),
        alike(table, stimulus),
        labels(table, stimulus, against.labels),
        coverage(table, stimulus, against),
        leaks(table, stimulus, against),
    ):
        faults += shorten(found)
    models = (table["Model"] + " · " + table["Readout Type"].replace(READOUTS)).value_counts()
    counted = {str(name): int(rows) for name, rows in models.sort_index().items()}
    return Checked(str(path), len(table), counted, tuple(faults), _unchecked(table, against))


def read_index(path: Path) -> pd.DataFrame:
    """Read an index of trials (parquet or CSV) with at least ``trial`` and ``split``."""
    file = path / "index.parquet" if path.is_dir() else path
    return read_table(file, ("trial", "split"))


def _unchecked(table: pd.DataFrame, against: Reference) -> tuple[str, ...]:
    """Return what could not be checked, as text."""
    left = []
    if against.labels is None and against.index is None:
        left.append("whether the stimuli are known and all there: no list of them was given")
    if against.labels is None:
        left.append("recorded outcomes: no official outcomes were given")
    if against.index is None and against.fitted is None and "Split" not in table.columns:
        left.append("leakage of splits: no index, no list of fitted stimuli, no column Split")
    return tuple(left)


# Check of files of responses: errors that stop an analysis, and what it would leave out.

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
        As for `results.read_any_responses`.
    labels
        Official outcomes, with which the labels of the responses must agree; None: not checked.
    expected
        Stimuli that a session must have, as for `exclusions.flag_sessions`.
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
