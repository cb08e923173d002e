"""Protection of free text against formula injection in spreadsheets, and its reversal.

Quoting in CSV does not protect: a spreadsheet removes the quotes and then checks the first
character. If semicolons or tabs separate cells (as in many European locales), quotes in the middle
of a line have no effect, so a character after a semicolon, tab or line end can start a cell too.
"""

from __future__ import annotations

import re

GUARD = "'"
RULE = (
    "In CSV and TSV files, an apostrophe is inserted in text that a spreadsheet could interpret as "
    "a formula: before =, +, -, @ and ' (also in their full-width forms) at the beginning of a "
    "cell and after each semicolon, tab or line end in it (spaces, quotes and control characters "
    "in between are skipped), and before a tab or line end at the beginning of a cell. Remove "
    "this one apostrophe in the same positions to restore the text. Parquet files contain the "
    "original text."
)
"""Description of the protection, for the data dictionary."""

# Both directions find the same positions: the guard neither separates cells nor is it skipped.
_BEGIN = r"(?:\A|[;\t\r\n])"
_SKIPPED = '[ "\x00-\x08\x0b\x0c\x0e-\x1f\x7f\x85\xa0\u2028\u2029\u3000\ufeff]*'
_FORMULA = "['=+\\-@\uff1d\uff0b\uff0d\uff20\uff07]"
_UNGUARDED = re.compile(rf"{_BEGIN}{_SKIPPED}(?={_FORMULA})|\A(?=[\t\r\n])")
_GUARDED = re.compile(rf"({_BEGIN}{_SKIPPED}){GUARD}")


def guard_cell(text: str) -> str:
    """Return ``text`` as a cell that spreadsheets display as text; see `RULE`."""
    return _UNGUARDED.sub(rf"\g<0>{GUARD}", text)


def restore_cell(cell: str) -> str:
    """Return the original text of a cell made by `guard_cell`."""
    return _GUARDED.sub(r"\1", cell)
