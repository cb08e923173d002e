"""Trials of a dataset that someone has looked at and found unusable, with the reason, in a file.

``unusable.csv`` lies in the dataset's folder and has the columns ``trial`` and ``reason``. A study
that is made from the dataset leaves these trials out; the trials themselves stay.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping

from physion.core.errors import BadInputError, UnknownNameError
from physion.core.files import read_plain, write_atomic
from physion.trials.dataset import Dataset

UNUSABLE = "unusable.csv"
COLUMNS = ("trial", "reason")
_MAX_BYTES = 10_000_000


def read_unusable(dataset: Dataset) -> dict[str, str]:
    """Return the reasons by trial; none without a file.

    Raises `BadInputError` for a file without the two columns, and for a trial without a reason or
    that the dataset does not have.
    """
    path = dataset.folder / UNUSABLE
    if not path.exists():
        return {}
    text = read_plain(path, _MAX_BYTES).decode("utf-8-sig", errors="replace")
    rows = csv.DictReader(io.StringIO(text))
    if not set(COLUMNS) <= set(rows.fieldnames or ()):
        raise BadInputError(f"{path} must have the columns {' and '.join(COLUMNS)}")
    found = {}
    known = set(dataset.index["trial"])
    for number, row in enumerate(rows, start=1):
        trial, reason = ((row[name] or "").strip() for name in COLUMNS)
        if trial not in known:
            raise BadInputError(f"{path}, row {number}: the dataset has no trial {trial[:100]!r}")
        if not reason:
            raise BadInputError(f"{path}, row {number}: why is {trial} unusable? Give a reason")
        found[trial] = reason
    return found


def mark_unusable(dataset: Dataset, reasons: Mapping[str, str]) -> dict[str, str]:
    """Add trials with their reasons to the file of a dataset; return all of its marks.

    An empty reason takes the mark back. Raises `UnknownNameError` for a trial that the dataset does
    not have.
    """
    marks = read_unusable(dataset)
    known = set(dataset.index["trial"])
    for trial, reason in reasons.items():
        if trial not in known:
            raise UnknownNameError(f"trial of {dataset.folder}:", trial, known)
        words = " ".join(reason.split())
        if words:
            marks[trial] = words
        else:
            marks.pop(trial, None)
    buffer = io.StringIO()
    csv.writer(buffer, lineterminator="\n").writerows([COLUMNS, *sorted(marks.items())])
    write_atomic(dataset.folder / UNUSABLE, buffer.getvalue().encode())
    return marks
