"""Cells of free text that no spreadsheet takes for a formula, and back again.

Quotes of CSV do not help: a spreadsheet takes them off and then looks at the first character. Where
semicolons or tabs divide cells (as in many European settings), quotes in the middle of a line are
no quotes, so that what follows a semicolon, tab or end of line is a first character too.
"""

from __future__ import annotations

import re

GUARD = "'"
RULE = (
    "In CSV and TSV files, text that a spreadsheet could take for a formula has an apostrophe put "
    "in: before =, +, -, @ and ' (also in their full-width forms) at the beginning of a cell and "
    "after each semicolon, tab or end of line in it (spaces, quotes and control characters in "
    "between do not count), and before a tab or end of line at the beginning of a cell. Take that "
    "one apostrophe off in the same places to have the text back. Parquet files hold the text as "
    "it was."
)
"""What a data dictionary says of it."""

# Both directions find the same places: the guard itself divides no cells and is skipped by none.
_BEGIN = r"(?:\A|[;\t\r\n])"
_SKIPPED = '[ "\x00-\x08\x0b\x0c\x0e-\x1f\x7f\x85\xa0\u2028\u2029\u3000\ufeff]*'
_FORMULA = "['=+\\-@\uff1d\uff0b\uff0d\uff20\uff07]"
_UNGUARDED = re.compile(rf"{_BEGIN}{_SKIPPED}(?={_FORMULA})|\A(?=[\t\r\n])")
_GUARDED = re.compile(rf"({_BEGIN}{_SKIPPED}){GUARD}")


def guard_cell(text: str) -> str:
    """``text`` as a cell that is shown as text; see `RULE`."""
    return _UNGUARDED.sub(rf"\g<0>{GUARD}", text)


def restore_cell(cell: str) -> str:
    """The text of a cell that `guard_cell` made."""
    return _GUARDED.sub(r"\1", cell)
