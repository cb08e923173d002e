"""One table as CSV and as parquet, written part by part; the same rows give the same bytes."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType

import pyarrow as pa
import pyarrow.parquet as pq
from pyarrow import csv

from physion.analysis.people.response_schema import Column
from physion.experiment.export.arrow_types import arrow_schema
from physion.experiment.export.spreadsheet import guard_cell

NAMES = frozenset({"participant", "session", "scenario", "stimulus", "kind"})
"""Text columns whose values are hashes or made of letters, digits and ._+-, so that they are never
taken for formulas: they stay as they are."""


class TableFiles:
    """Writes ``NAME.csv`` and ``NAME.parquet`` in a folder; a context manager.

    CSV: UTF-8, a header, lines that end in LF; text is guarded (`guard_cell`), and quoted wherever
    the table has free text at all. Empty cells are empty. Parquet: Zstandard, empty cells null.
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
                    # A dictionary of texts that are all different only costs.
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
        """Add rows."""
        self.rows += table.num_rows
        self._parquet.write_table(table)
        if self._csv is not None:
            self._csv.write_table(self._guarded(table))

    def _guarded(self, table: pa.Table) -> pa.Table:
        for name in self._texts:
            cells = table.column(name).to_pylist()
            guarded = [None if cell is None else guard_cell(cell) for cell in cells]
            place = table.schema.get_field_index(name)
            table = table.set_column(place, name, pa.array(guarded, pa.string()))
        return table

    def __enter__(self) -> TableFiles:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        at: TracebackType | None,
    ) -> None:
        self._stack.close()
