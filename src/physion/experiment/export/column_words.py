"""What other conventions call the parts of a column, and labels that their file names may hold."""

from __future__ import annotations

import re
from collections.abc import Iterable

from physion.analysis.people.response_schema import Column

KIND_WORDS = {
    "text": "text",
    "integer": "whole number",
    "number": "number",
    "flag": "true or false",
    "choice": "one of the given words",
    "time": "moment in ISO 8601, UTC",
}


def label_of(name: str) -> str:
    """The letters and digits (ASCII) of a name; ``x`` where it has none."""
    return re.sub(r"[^A-Za-z0-9]", "", name) or "x"


def labels_of(names: Iterable[str]) -> dict[str, str]:
    """A label of letters and digits for each name, no two alike even where case is ignored."""
    found: dict[str, str] = {}
    taken: set[str] = set()
    for name in names:
        label, number = label_of(name), 2
        while label.lower() in taken:
            label, number = f"{label_of(name)}{number}", number + 1
        taken.add(label.lower())
        found[name] = label
    return found


def levels_of(column: Column) -> tuple[str, ...]:
    """The words that a cell may hold, where they are few."""
    return ("true", "false") if column.kind == "flag" else column.choices
