"""Checked reading of CSV files that users edit, with the row numbers that spreadsheets show."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator
from pathlib import Path

from physion.core.errors import BadInputError


def csv_rows(
    path: Path, content: bytes, columns: tuple[str, ...]
) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield the row number and the cells of each non-empty row of a CSV file.

    Parameters
    ----------
    path
        Where ``content`` was read from; used in error messages only.
    content
        The bytes of the file, UTF-8 with or without a byte order mark.
    columns
        Columns that the header must have. Further columns are allowed.

    Yields
    ------
    tuple of int and dict
        Row number as a spreadsheet shows it (the header is row 1), and the stripped cells by
        column name.

    Raises
    ------
    BadInputError
        The file is not UTF-8 or not CSV, the header lacks a column or has one twice, or a row has
        another number of cells than the header.
    """
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise BadInputError(f"{path} is not UTF-8 text; save it as CSV UTF-8") from error
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    try:
        header = [name.strip() for name in next(reader, [])]
        _check_header(path, header, columns)
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


def _check_header(path: Path, header: list[str], columns: tuple[str, ...]) -> None:
    """Check that the header has all ``columns`` and no duplicates."""
    duplicates = [name for name in header if header.count(name) > 1]
    if duplicates:
        raise BadInputError(f"{path} has more than one column {duplicates[0]!r}")
    for name in columns:
        if name not in header:
            raise BadInputError(f"{path} lacks the column {name!r}; it needs {', '.join(columns)}")
