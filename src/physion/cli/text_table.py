"""Text tables that are not cut to the terminal's width, so that they can be searched and piped."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd


def text_table(table: pd.DataFrame, title: str = "") -> str:
    """Return a table as text: a header and one line per row, columns separated by two spaces.

    Numbers have three decimals and are aligned to the right; NaN is an empty cell.
    """
    import pandas as pd

    columns = [[str(name), *map(_cell, table[name])] for name in table.columns]
    widths = [max(map(len, cells)) for cells in columns]
    right = [pd.api.types.is_numeric_dtype(table[name]) for name in table.columns]
    lines = [
        "  ".join(
            cell.rjust(width) if number else cell.ljust(width)
            for cell, width, number in zip(cells, widths, right, strict=True)
        ).rstrip()
        for cells in zip(*columns, strict=True)
    ]
    return "\n".join([*([title] if title else []), *lines])


def _cell(value: object) -> str:
    import pandas as pd

    if value is None or value is pd.NA:
        return ""
    if not isinstance(value, float):
        return str(value)
    if pd.isna(value):
        return ""
    return f"{value:.0f}" if value.is_integer() and abs(value) > 1 else f"{value:.3f}"
