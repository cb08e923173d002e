"""The columns of `response_schema` in Arrow and parquet, and back in the analysis' types."""

from __future__ import annotations

from collections.abc import Sequence

import pandas as pd
import pyarrow as pa

from physion.analysis.people.response_schema import Column

ARROW_TYPES = {
    "text": pa.string(),
    "choice": pa.string(),
    "time": pa.string(),
    "integer": pa.int64(),
    "number": pa.float64(),
    "flag": pa.bool_(),
}


def arrow_schema(columns: Sequence[Column]) -> pa.Schema:
    """The columns with the types that they have in Arrow and parquet."""
    return pa.schema([pa.field(column.name, ARROW_TYPES[column.kind]) for column in columns])


def as_frame(table: pa.Table, columns: Sequence[Column]) -> pd.DataFrame:
    """A table of Arrow with the types of `response_schema.check_table`."""
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
