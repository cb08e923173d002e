"""Checks of a file of predictions that need the file alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pandas as pd

from physion.analysis.tables.predictions import DISTINGUISHING, READOUTS, REQUIRED
from physion.core.names import scenario_of

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
