"""Rows of a CSV file from outside, each with the number that a spreadsheet shows for it."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

from physion.errors import BadInputError


def csv_rows(
    path: Path, content: bytes, columns: tuple[str, ...]
) -> Iterator[tuple[int, dict[str, str]]]:
    """Number and cells of each row that is not empty; the header is row 1.

    ``content`` was read from ``path``. `BadInputError` for what is no UTF-8 or no CSV, for a header
    without one of ``columns`` or with a name twice, and for a row of another length.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path} is not UTF-8 text; save it as CSV UTF-8") from error
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        header = [name.strip() for name in next(reader, [])]
        _check(path, header, columns)
        for row, cells in enumerate(reader, start=2):
            if not any(cells):
                continue
            if len(cells) != len(header):
                raise BadInputError(
                    f"{path}, row {row}: {len(cells)} cells, not {len(header)} as in the header"
                )
            yield row, dict(zip(header, map(str.strip, cells), strict=True))
    except csv.Error as error:
        raise BadInputError(f"{path}, line {reader.line_num}: not CSV: {error}") from error


def _check(path: Path, header: list[str], columns: tuple[str, ...]) -> None:
    twice = [name for name in header if header.count(name) > 1]
    if twice:
        raise BadInputError(f"{path} has more than one column {twice[0]!r}")
    for name in columns:
        if name not in header:
            raise BadInputError(f"{path} lacks the column {name!r}; it needs {', '.join(columns)}")
