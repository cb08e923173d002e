"""Tables from outside: reading, and one description of what their columns may hold.

A table is described by its `Column` values: meaning, allowed values, and other headers under which
the column may come, such as the headers of the official files. `check_table` reads any table by
such a description and refuses the first cell that breaks it, with file, row and column. Inside the
package all columns have the names of the description.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass
from itertools import chain
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from physion.core.errors import BadInputError
from physion.core.files import check_digest, digest_path

FORMULA = r"\A([=+\-@\t\r\n'])"
"""Begin of a text that a spreadsheet would take for a formula: an apostrophe is put before it."""


def read_csv(path: Path, columns: Iterable[str] = ()) -> pd.DataFrame:
    """Read the CSV file at ``path`` as text; it must have ``columns`` and at least one row.

    Raises `BadInputError` for a file that is absent, of another kind, empty, lacks a column, or
    was changed since this package wrote it with its SHA-256.
    """
    table = parse_csv(_read_checked(path), str(path))
    require_columns(table, columns, str(path))
    if table.empty:
        raise BadInputError(f"{path} has a header and no rows")
    return table


def parse_csv(content: bytes, where: str) -> pd.DataFrame:
    """Return the cells of a CSV table as text; ``where``: what it is called in messages.

    Raises `BadInputError` if the content is not such a table.
    """
    header = content.partition(b"\n")[0]
    for mark, name in ((b";", "semicolons"), (b"\t", "tabs")):
        if mark in header and b"," not in header:
            raise BadInputError(
                f"{where} separates its columns with {name}; save it as CSV with commas between "
                "columns, and with points in numbers"
            )
    try:
        table = pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False, encoding="utf-8")
    except UnicodeDecodeError as error:
        raise BadInputError(
            f"{where} is not a CSV table: it is no text (UTF-8); save the table as CSV with commas"
        ) from error
    except (pd.errors.ParserError, pd.errors.EmptyDataError) as error:
        raise BadInputError(f"{where} is not a CSV table: {error}") from error
    if not isinstance(table.index, pd.RangeIndex):
        # pandas takes the first cells of such rows for an index, which shifts all others.
        raise BadInputError(f"{where}: its rows have more cells than its header")
    return table


def read_table(path: Path, columns: Iterable[str] = ()) -> pd.DataFrame:
    """Read a parquet table with its types, or a CSV file as text (`read_csv`).

    Raises `BadInputError` as `read_csv` does.
    """
    if path.suffix.lower() != ".parquet":
        return read_csv(path, columns)
    content = _read_checked(path)
    try:
        table = pd.read_parquet(io.BytesIO(content), engine="pyarrow")
    except (OSError, ValueError) as error:
        raise BadInputError(f"{path} is not a parquet table: {error}") from error
    require_columns(table, columns, str(path))
    return table


def _read_checked(path: Path) -> bytes:
    """Return the bytes of a file, compared with the SHA-256 in its digest file, if there is one."""
    if not path.is_file():
        raise BadInputError(f"{path} is not a file")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise BadInputError(f"{path} cannot be read: {error.strerror}") from error
    digest = digest_path(path).name
    check_digest(path, content, f"make it again, or delete {digest} to use the table as it is")
    return content


# Descriptions of tables.

Kind = Literal["text", "integer", "number", "flag", "choice", "time"]
"""``text``; whole or any ``number``; ``flag``: True or False; ``choice``: one of ``choices``;
``time``: a moment in ISO 8601 with its offset from UTC."""


@dataclass(frozen=True)
class Column:
    """A column of a table: its meaning and its allowed values.

    ``required``: the column must exist. ``may_be_empty``: a cell may be empty (unknown). The bounds
    ``low`` and ``high`` are inclusive and in ``unit``. ``also``: other headers that it may have in
    a file, of which the first that is there counts. Headers may be in any case, with spaces around.
    """

    name: str
    kind: Kind
    about: str
    unit: str = ""
    low: float | None = None
    high: float | None = None
    choices: tuple[str, ...] = ()
    required: bool = False
    may_be_empty: bool = True
    also: tuple[str, ...] = ()


def must(name: str, kind: Kind, about: str, **rest: Any) -> Column:
    """Return a column that must exist and have a value in every row."""
    return Column(name, kind, about, required=True, may_be_empty=False, **rest)


FLAGS = {
    **dict.fromkeys(("true", "1", "1.0", "yes"), True),
    **dict.fromkeys(("false", "0", "0.0", "no"), False),
}
"""Words for True and False in a table, in any case."""


def data_dictionary(columns: Sequence[Column]) -> list[dict[str, Any]]:
    """Return the columns as plain values for JSON: name, kind, about, unit, bounds, choices, ..."""
    found = []
    for column in columns:
        values = {**asdict(column), "choices": list(column.choices)}
        del values["also"]
        found.append(values)
    return found


@dataclass(frozen=True)
class BadCell:
    """A cell that its column does not allow: row from 1, header in the file, what it holds."""

    row: int
    header: str
    value: str
    expected: str

    def __str__(self) -> str:
        return (
            f"row {self.row} of column {self.header!r} holds {self.value!r}; "
            f"expected {self.expected}"
        )


def check_table(table: pd.DataFrame, columns: Sequence[Column], where: str) -> pd.DataFrame:
    """Return ``table`` with the types of its ``columns``; columns not described are dropped.

    Cells may be text, as from CSV, or typed, as from parquet. Resulting types: str for text, choice
    and time (empty if unknown), Int64 for integer, float64 (NaN) for number, boolean for flag (bool
    if no cell may be empty). An optional column that is absent stays absent. Raises `BadInputError`
    for a missing column or the first cell that is not allowed.
    """
    typed, missing, bad = inspect_table(table, columns)
    if missing:
        names = ", ".join(" or ".join((column.name, *column.also)) for column in missing)
        given = ", ".join(map(str, table.columns[:12]))
        raise BadInputError(f"{where} lacks the column(s) {names}; it has: {given}")
    if bad:
        raise BadInputError(f"{where}: {bad[0]}")
    for column in columns:
        if column.kind == "flag" and not column.may_be_empty and column.name in typed:
            typed[column.name] = typed[column.name].astype(bool)
    return typed


def inspect_table(
    table: pd.DataFrame, columns: Sequence[Column]
) -> tuple[pd.DataFrame, list[Column], list[BadCell]]:
    """Return ``table`` as `check_table` does, with what is wrong with it.

    Returns
    -------
    typed
        The columns that are there; a cell that is not allowed is empty.
    missing
        Required columns that are not there.
    bad
        Every cell that is not allowed, column by column.
    """
    typed, bad = {}, []
    missing = []
    plain = {str(name).strip().lower(): name for name in reversed(table.columns)}
    for column in columns:
        names = (column.name, *column.also)
        exact = (name for name in names if name in table)
        alike = (plain[name.lower()] for name in names if name.lower() in plain)
        header = next(chain(exact, alike), None)
        if header is None:
            missing += [column] if column.required else []
            continue
        values = table[header]
        text = values.astype(object).where(values.notna(), "").astype(str).str.strip()
        typed[column.name], faults = _typed(text, column)
        bad += [
            BadCell(int(row) + 1, header, text.iloc[row][:80], expected)
            for wrong, expected in faults
            for row in np.flatnonzero(wrong.to_numpy())
        ]
    return pd.DataFrame(typed, index=table.index).reset_index(drop=True), missing, bad


def _typed(text: pd.Series, column: Column) -> tuple[pd.Series, list[tuple[pd.Series, str]]]:
    """Return the values of a column, and which cells are not allowed, with what was expected."""
    empty = text == ""
    absent = [] if column.may_be_empty else [(empty, "a value")]
    match column.kind:
        case "integer" | "number":
            values, wrong, expected = _numbers(text, empty, column)
        case "flag":
            flags = text.str.lower().map(FLAGS)
            values, wrong = flags.astype("boolean"), ~empty & flags.isna()
            expected = "True or False"
        case "choice":
            lower = text.str.lower()
            wrong, expected = ~empty & ~lower.isin(column.choices), " or ".join(column.choices)
            values = lower.where(~wrong, "")
        case "time":
            given = text.where(~empty)
            moments = pd.to_datetime(given, errors="coerce", utc=True, format="ISO8601")
            wrong, expected = ~empty & moments.isna(), "a time in ISO 8601"
            values = text.where(~wrong, "")
        case "text":
            return text, absent
    return values, [*absent, (wrong, expected)]


def _numbers(text: pd.Series, empty: pd.Series, column: Column) -> tuple[pd.Series, pd.Series, str]:
    numbers = pd.to_numeric(text.where(~empty), errors="coerce").astype(np.float64)
    low = -np.inf if column.low is None else column.low
    high = np.inf if column.high is None else column.high
    good = np.isfinite(numbers) & (numbers >= low) & (numbers <= high)
    whole = column.kind == "integer"
    if whole:
        good &= numbers == np.floor(numbers)
    expected = f"a {'whole ' if whole else ''}number from {low:g} to {high:g}"
    kept = numbers.where(good)
    return kept.astype("Int64") if whole else kept, ~empty & ~good, expected


def require_columns(table: pd.DataFrame, columns: Iterable[str], where: str) -> None:
    """Raise `BadInputError` unless ``table`` has every one of ``columns``."""
    missing = [column for column in columns if column not in table.columns]
    if missing:
        result = ", ".join(map(str, table.columns[:12]))
        raise BadInputError(f"{where} lacks the column(s) {', '.join(missing)}; it has: {result}")


def markdown_table(
    head: Sequence[object], rows: Iterable[Sequence[object]], *, tight: bool = False
) -> str:
    """Return a Markdown table; a vertical bar in a cell is escaped.

    ``tight``: without spaces in the rule below the head, and around empty names of columns.
    """
    cells = [[str(cell).replace("|", "\\|") for cell in row] for row in (head, *rows)]
    first, *others = (f"| {' | '.join(row)} |" for row in cells)
    rule = f"| {' | '.join(['---'] * len(head))} |"
    if tight:
        first, rule = first.replace("|  ", "| "), rule.replace(" ", "")
    return "\n".join([first, rule, *others])


def refuse_duplicates(names: pd.Series, where: str) -> None:
    """Raise `BadInputError` with the first name that occurs twice."""
    twice = names[names.duplicated()]
    if len(twice):
        raise BadInputError(f"{where}: {twice.iloc[0]!r} stands in two rows; keep one")
