"""Writer of one table as CSV and parquet, in batches; the same rows give the same bytes."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow import csv

from physion.analysis.people.responses import Column
from physion.experiment.export.arrow_types import arrow_schema
from physion.experiment.export.spreadsheet import guard_cell

NAMES = frozenset({"participant", "session", "scenario", "condition", "stimulus", "kind"})
"""Text columns that need no protection against formulas: their values are hashes or consist of
letters, digits and ._+- and start with a letter or digit."""


class TableWriter:
    """Context manager that writes ``NAME.csv`` and ``NAME.parquet`` in a folder.

    CSV: UTF-8 with a header and LF line ends; free text is protected by `guard_cell` and quoted
    where needed. Parquet: Zstandard compression; empty cells are null.

    Parameters
    ----------
    folder, name
        Folder, and name of the files without ending.
    columns
        Columns of the table.
    with_csv
        Whether to write the CSV file too.
    level
        Compression level of the parquet file.
    """

    def __init__(
        self,
        folder: Path,
        name: str,
        columns: Sequence[Column],
        *,
        with_csv: bool = True,
        level: int = 3,
    ) -> None:
        self.csv = folder / f"{name}.csv"
        self.rows = 0
        self._texts = [c.name for c in columns if c.kind == "text" and c.name not in NAMES]
        self._stack = contextlib.ExitStack()
        schema = arrow_schema(columns)
        with contextlib.ExitStack() as opened:
            self._parquet = opened.enter_context(
                pq.ParquetWriter(
                    folder / f"{name}.parquet",
                    schema,
                    compression="zstd",
                    compression_level=level,
                    # No dictionary for free texts, which hardly ever repeat.
                    use_dictionary=[c.name for c in columns if c.name not in self._texts],
                )
            )
            self._csv = None
            if with_csv:
                file = opened.enter_context(self.csv.open("wb"))
                file.write(",".join(column.name for column in columns).encode() + b"\n")
                options = csv.WriteOptions(
                    include_header=False, quoting_style="needed" if self._texts else "none"
                )
                self._csv = opened.enter_context(csv.CSVWriter(file, schema, write_options=options))
            self._stack = opened.pop_all()

    def write(self, table: pa.Table) -> None:
        """Append rows."""
        self.rows += table.num_rows
        self._parquet.write_table(table)
        if self._csv is not None:
            self._csv.write_table(self._guarded(table))

    def _guarded(self, table: pa.Table) -> pa.Table:
        """Return the table with its free texts protected by `guard_cell`."""
        for name in self._texts:
            cells = table.column(name).to_pylist()
            guarded = [None if cell is None else guard_cell(cell) for cell in cells]
            index = table.schema.get_field_index(name)
            table = table.set_column(index, name, pa.array(guarded, pa.string()))
        return table

    def __enter__(self) -> TableWriter:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._stack.close()
