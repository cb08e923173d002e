"""Conversion of the columns of `response_schema` to Arrow types and to data frames."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
import pyarrow as pa

from physion.analysis.people.responses import Column

ARROW_TYPES = {
    "text": pa.string(),
    "choice": pa.string(),
    "time": pa.string(),
    "integer": pa.int64(),
    "number": pa.float64(),
    "flag": pa.bool_(),
}


def arrow_schema(columns: Sequence[Column]) -> pa.Schema:
    """Return the Arrow (and parquet) schema of the columns."""
    return pa.schema([pa.field(column.name, ARROW_TYPES[column.kind]) for column in columns])


def as_frame(table: pa.Table, columns: Sequence[Column]) -> pd.DataFrame:
    """Convert an Arrow table to a data frame with the types of `response_schema.check_table`."""
    nullable = {pa.int64(): pd.Int64Dtype(), pa.bool_(): pd.BooleanDtype()}
    frame = table.to_pandas(types_mapper=nullable.get)
    typed = {}
    for column in columns:
        values = frame[column.name]
        if ARROW_TYPES[column.kind] == pa.string():
            values = values.astype("str").fillna("")
        elif column.kind == "flag" and not column.may_be_empty:
            values = values.astype(bool)
        typed[column.name] = values
    return pd.DataFrame(typed)
