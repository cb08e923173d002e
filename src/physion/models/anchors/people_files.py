"""Strict reader of the fraction of people who answered yes, by stimulus.

`physion.analysis.tables.responses` reads the same files for the comparison with people; models
cannot import it, because the analysis must run on tables alone.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Iterator
from pathlib import Path

from physion.errors import BadInputError
from physion.stimulus_names import canonical_name

FILES = re.compile(r"human_accuracy-[a-zA-Z]+(-redyellow)?_pilot-.*\.csv$")
"""Names of the official files."""
LABELS_FILE = "stimulus_names_and_labels.csv"
"""The official file of outcomes; it may lie in these places, relative to the answers' folder."""
LABELS_PLACES = (".", "..", "../stimuli")
BOOLEANS = {"true": True, "1": True, "false": False, "0": False}


def read_people(path: Path) -> dict[str, float]:
    """Read the fraction who answered yes, by canonical name of the stimulus.

    - A CSV file with the columns ``stimulus`` and ``p_yes``.
    - An official CSV file with the columns ``stim_ID`` and ``correct``, or a folder of such files
      called ``human_accuracy-<scenario>_pilot-*.csv``. The fraction of correct answers becomes
      that of yes by the outcome, from `LABELS_FILE` in or next to the folder. Stimuli whose names
      contain ``-redyellow``, an earlier look of Dominoes, are left out as in the paper.

    Raises `BadInputError` for a path without such a table, a missing column, a value outside 0..1,
    a stimulus that occurs twice, and one without an outcome.
    """
    if path.is_dir():
        files = [file for file in sorted(path.iterdir()) if FILES.match(file.name)]
        if not files:
            raise BadInputError(f"{path} holds no human_accuracy-<scenario>_pilot-*.csv")
    else:
        files = [path]
    outcomes = _read_outcomes(path if path.is_dir() else path.parent)
    people: dict[str, float] = {}
    for file in files:
        _add_file(file, outcomes, people)
    return people


def as_fraction(text: object, where: str) -> float:
    """Return a number in 0..1; raise `BadInputError` for anything else."""
    try:
        value = float(text)  # type: ignore[arg-type]
    except (TypeError, ValueError):
        value = math.nan
    if not 0 <= value <= 1:
        raise BadInputError(f"{where}: {text!r} is not a fraction from 0 to 1")
    return value


def _add_file(file: Path, outcomes: dict[str, bool], people: dict[str, float]) -> None:
    """Add the rows of one table to ``people``."""
    official = "stim_ID" in _header(file)
    name, value = ("stim_ID", "correct") if official else ("stimulus", "p_yes")
    for line, row in _rows(file, (name, value)):
        if official and "-redyellow" in file.name + row[name]:
            continue
        stimulus, where = canonical_name(row[name]), f"{file}, line {line}"
        if stimulus in people:
            raise BadInputError(f"{where}: stimulus {stimulus!r} occurs twice")
        fraction = as_fraction(row[value], where)
        if official and stimulus not in outcomes:
            raise BadInputError(
                f"{where}: the outcome of {stimulus!r} says what correct answers were, but is not "
                f"known; put the official {LABELS_FILE} next to the folder"
            )
        people[stimulus] = 1 - fraction if official and not outcomes[stimulus] else fraction


def _read_outcomes(folder: Path) -> dict[str, bool]:
    """Return the outcomes of `LABELS_FILE` in or next to a folder, empty if there is none."""
    paths = [folder / place / LABELS_FILE for place in LABELS_PLACES]
    file = next((path for path in paths if path.is_file()), None)
    outcomes: dict[str, bool] = {}
    for line, row in [] if file is None else _rows(file, ("stim_ID", "label")):
        outcome = BOOLEANS.get(row["label"].strip().lower())
        if outcome is None:
            raise BadInputError(f"{file}, line {line}: label {row['label']!r} is not true or false")
        outcomes[canonical_name(row["stim_ID"])] = outcome
    return outcomes


def _header(file: Path) -> tuple[str, ...]:
    """Return the names of the columns of a CSV file."""
    try:
        with file.open(encoding="utf-8-sig", newline="") as lines:
            return tuple(next(csv.reader(lines), ()))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise BadInputError(f"{file}: people's answers cannot be read: {error}") from error


def _rows(file: Path, columns: tuple[str, ...]) -> Iterator[tuple[int, dict[str, str]]]:
    """Yield line number and values of every row of a CSV file that has all ``columns``."""
    header = _header(file)
    missing = [name for name in columns if name not in header]
    if missing:
        raise BadInputError(
            f"{file} lacks the column {missing[0]!r}; people's answers have the columns stimulus "
            "and p_yes, or the official ones stim_ID and correct"
        )
    with file.open(encoding="utf-8-sig", newline="") as lines:
        try:
            for number, row in enumerate(csv.DictReader(lines), start=2):
                if any(row[name] is None for name in columns):
                    raise BadInputError(f"{file}, line {number}: fewer values than columns")
                yield number, row
        except (UnicodeDecodeError, csv.Error) as error:
            raise BadInputError(f"{file}: people's answers cannot be read: {error}") from error
