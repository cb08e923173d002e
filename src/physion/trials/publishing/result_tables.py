"""Tables of predictions with the names of scenarios that the notebooks of the study use.

The columns of our tables are the official ones; the scenarios in them have our names (``collide``),
while the notebooks select ``collision``, ``containment``, ``clothiness``, ``linking``,
``rollingsliding`` and ``towers`` (``change_names`` in ``physion/metrics.py`` of physics-models).
"""

from __future__ import annotations

import io
from pathlib import Path

import pandas as pd

from physion.atomic import folder_for_writing, write_atomic
from physion.digests import check_digest
from physion.errors import BadInputError
from physion.stimulus_names import NAMES

MARK = "Readout Test Data"
"""Column by which a CSV file is recognised as a table of predictions."""
COLUMNS = (
    "Readout Train Data",
    MARK,
    "Encoder Pre-training Dataset",
    "Encoder Training Dataset",
    "Dynamics Training Dataset",
)
"""Columns that hold names of scenarios."""
_OLD = {name: names.experiment for name, names in NAMES.items()}
_OLD |= {f"no_{name}": f"no_{old}" for name, old in _OLD.items()}
"""Name in the notebooks by our name; ``no_`` marks a training on all other scenarios."""


def export_result_tables(folder: Path, out: Path) -> list[Path]:
    """Write every table of predictions under ``folder`` into ``out``, with the old names.

    Returns the paths written. All other cells and columns stay as they are. The tables belong into
    ``results/csv/models`` of the study's repository.

    Raises
    ------
    BadInputError
        If there is no table of predictions, two tables have the same name, or a table is damaged.
    """
    tables: dict[str, tuple[Path, str]] = {}
    if out.resolve().is_relative_to(folder.resolve()):
        raise BadInputError(f"{out} lies in {folder}; choose a folder outside it")
    for path in sorted(folder.rglob("*.csv")):
        text = _with_old_names(path)
        if text is None:
            continue
        if path.name in tables:
            raise BadInputError(
                f"{tables[path.name][0]} and {path} have the same name; export one folder at a time"
            )
        tables[path.name] = path, text
    if not tables:
        raise BadInputError(
            f"{folder} has no table of predictions; give the folder that `physion evaluate` wrote"
        )
    with folder_for_writing(out):
        for name, (_, text) in tables.items():
            write_atomic(out / name, text.encode())
    return [out / name for name in tables]


def _with_old_names(path: Path) -> str | None:
    """Return the text of a table with the old names; None if it is no table of predictions."""
    try:
        content = path.read_bytes()
        if MARK not in pd.read_csv(io.BytesIO(content), nrows=0).columns:
            return None
        check_digest(path, content, "run physion evaluate again")
        # As text, so that every other cell stays as it is.
        table = pd.read_csv(io.BytesIO(content), dtype=str, keep_default_na=False)
    except (ValueError, OSError) as error:
        raise BadInputError(f"{path} is not a table: {error}") from error
    for column in COLUMNS:
        if column in table.columns:
            table[column] = table[column].replace(_OLD)
    return str(table.to_csv(index=False, lineterminator="\n"))
