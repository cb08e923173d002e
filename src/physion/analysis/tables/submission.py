"""Validation of a file of predictions: every fault with its row.

Rows are counted from 1 below the header. An *error* makes a comparison wrong or impossible; a
*warning* should be checked.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from physion.analysis.tables.csv_table import read_csv, read_table
from physion.analysis.tables.predictions import READOUTS
from physion.analysis.tables.submission_rows import (
    Fault,
    alike,
    blank,
    columns,
    duplicates,
    outcomes,
    probabilities,
    readouts,
    shorten,
)
from physion.analysis.tables.submission_trials import Reference, coverage, labels, leaks
from physion.core.names import canonical_name

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
