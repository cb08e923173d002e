"""Readers of tables from outside: complete and checked, or refused with one clear message."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.core.errors import BadInputError
from physion.core.files import check_digest, digest_path

Array = npt.NDArray[np.float64]


def read_csv(path: Path, columns: Iterable[str]) -> pd.DataFrame:
    """Read the CSV file at ``path`` as text; it must have ``columns`` and at least one row.

    Raises `BadInputError` for a file that is absent, of another kind, empty, lacks a column, or
    was changed since this package wrote it with its SHA-256.
    """
    content = _read_checked(path)
    try:
        table = pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False, encoding="utf-8")
    except (pd.errors.ParserError, pd.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise BadInputError(f"{path} is not a CSV table: {error}") from error
    require_columns(table, columns, str(path))
    if table.empty:
        raise BadInputError(f"{path} has a header and no rows")
    return table


def read_table(path: Path, columns: Iterable[str]) -> pd.DataFrame:
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


def require_columns(table: pd.DataFrame, columns: Iterable[str], where: str) -> None:
    """Raise `BadInputError` unless ``table`` has every one of ``columns``."""
    missing = [column for column in columns if column not in table.columns]
    if missing:
        result = ", ".join(map(str, table.columns[:12]))
        raise BadInputError(f"{where} lacks the column(s) {', '.join(missing)}; it has: {result}")


def as_numbers(values: pd.Series, low: float, high: float, where: str) -> Array:
    """Return ``values`` as finite float64 in [low, high]; `BadInputError` names the first other
    one.
    """
    numbers: Array = np.asarray(pd.to_numeric(values, errors="coerce"), dtype=np.float64)
    good = np.isfinite(numbers) & (numbers >= low) & (numbers <= high)
    if not good.all():
        row = int(np.flatnonzero(~good)[0])
        raise BadInputError(
            f"{where}: row {row + 1} of column {values.name!r} holds {values.iloc[row]!r}; "
            f"expected a number from {low:g} to {high:g}"
        )
    return numbers


def as_booleans(values: pd.Series, where: str) -> npt.NDArray[np.bool_]:
    """Return ``values`` as bool: True/False, 1/0 or yes/no in any case; else raise
    `BadInputError`.
    """
    meaning = {"true": True, "1": True, "1.0": True, "yes": True}
    meaning |= {"false": False, "0": False, "0.0": False, "no": False}
    result = [meaning.get(str(value).strip().lower()) for value in values]
    for row, value in enumerate(result):
        if value is None:
            raise BadInputError(
                f"{where}: row {row + 1} of column {values.name!r} holds {values.iloc[row]!r}; "
                "expected True or False"
            )
    return np.array(result, dtype=bool)


def refuse_duplicates(names: pd.Series, where: str) -> None:
    """Raise `BadInputError` with the first name that occurs twice."""
    twice = names[names.duplicated()]
    if len(twice):
        raise BadInputError(f"{where}: {twice.iloc[0]!r} stands in two rows; keep one")
