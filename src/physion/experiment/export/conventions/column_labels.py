"""Labels for file names and descriptions of columns, as Psych-DS and BIDS need them."""

from __future__ import annotations

import re
from collections.abc import Iterable

from physion.analysis.people.responses import Column

KIND_NAMES = {
    "text": "text",
    "integer": "whole number",
    "number": "number",
    "flag": "true or false",
    "choice": "one of the given words",
    "time": "moment in ISO 8601, UTC",
}


def file_label(name: str) -> str:
    """Return the ASCII letters and digits of a name, or ``x`` if it has none."""
    return re.sub(r"[^A-Za-z0-9]", "", name) or "x"


def unique_file_labels(names: Iterable[str]) -> dict[str, str]:
    """Return a label of letters and digits for each name, unique even when case is ignored."""
    labels: dict[str, str] = {}
    taken: set[str] = set()
    for name in names:
        label, number = file_label(name), 2
        while label.lower() in taken:
            label, number = f"{file_label(name)}{number}", number + 1
        taken.add(label.lower())
        labels[name] = label
    return labels


def column_levels(column: Column) -> tuple[str, ...]:
    """Return the allowed values of a flag or choice column; empty for other columns."""
    return ("true", "false") if column.kind == "flag" else column.choices
