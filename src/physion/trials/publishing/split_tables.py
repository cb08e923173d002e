"""Tables of a dataset for `datasets.load_dataset`: one parquet file for each split.

``index`` has the rows of the index; ``videos`` has what may be seen of a trial, with the observed
movie itself as a column of the type ``Video``. The front matter of the card names the files by
split, because the library otherwise gives all rows as training rows, with the labels of the tests.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from physion.atomic import write_atomic
from physion.trials.dataset import indexed_file

FOLDER = "data"
"""Folder of the tables, next to the card."""
HUB_SPLITS: Mapping[str, str] = {"training": "train", "testing": "test"}
"""Names of splits on the hub, where they differ from ours."""
SEEN = ("trial", "dataset", "scenario", "split", "look", "width", "height", "observed_frames")
"""Columns of the index in ``videos``; none reveals an outcome."""
_VIDEO = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
_ROWS = 100
"""Rows in a group of ``videos``, so that a reader need not hold all movies in memory."""


def table_configs(index: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the entry ``configs`` of the front matter: the files of each split by table."""
    configs = [_config("index", index, default=True)]
    seen = index[index["observed_movie"].notna()]
    return configs + ([_config("videos", seen)] if len(seen) else [])


def _config(name: str, index: pd.DataFrame, default: bool = False) -> dict[str, Any]:
    files = [
        {"split": HUB_SPLITS.get(split, split), "path": _path(name, split)}
        for split in sorted(set(index["split"]))
    ]
    return {"config_name": name, "data_files": files} | ({"default": True} if default else {})


def _path(name: str, split: str) -> str:
    return f"{FOLDER}/{name}-{HUB_SPLITS.get(split, split)}.parquet"


def write_split_tables(
    folder: Path, index: pd.DataFrame, out: Path, *, verify: bool = True
) -> list[Path]:
    """Write the tables of the dataset in ``folder`` below ``out``; return their paths.

    `BadInputError` if an observed movie cannot be read or, with ``verify``, does not have its
    SHA-256 in the index.
    """
    made = []
    (out / FOLDER).mkdir(parents=True, exist_ok=True)
    for split, rows in index.groupby("split", observed=True):
        path = out / _path("index", str(split))
        write_atomic(path, _parquet(pa.Table.from_pandas(rows, preserve_index=False)))
        made.append(path)
        seen = rows[rows["observed_movie"].notna()]
        if len(seen):
            path = out / _path("videos", str(split))
            write_atomic(path, _parquet(_videos(folder, seen, verify)))
            made.append(path)
    return made


def _videos(folder: Path, rows: pd.DataFrame, verify: bool) -> pa.Table:
    """Return the table ``videos``, with the types of the library in its schema."""
    table = pa.Table.from_pandas(rows[list(SEEN)], preserve_index=False)
    movies = [_movie(folder, row, verify) for row in rows.to_dict("records")]
    table = table.append_column("video", pa.array(movies, _VIDEO))
    features: dict[str, Any] = {
        name: {"dtype": "string" if kind in (pa.string(), pa.large_string()) else str(kind)}
        | {"_type": "Value"}
        for name, kind in zip(table.column_names, table.schema.types, strict=True)
    }
    features["video"] = {"_type": "Video"}
    text = json.dumps({"info": {"features": features}})
    strings = [
        field.with_type(pa.string()) if field.type == pa.large_string() else field
        for field in table.schema
    ]
    return table.cast(pa.schema(strings)).replace_schema_metadata({"huggingface": text})


def _movie(folder: Path, row: Mapping[Any, Any], verify: bool) -> dict[str, Any]:
    file = indexed_file(folder, row, "observed_movie", verify=verify)
    assert file is not None, "trials without a movie were left out"
    return {"bytes": file.read(), "path": file.path.name}


def _parquet(table: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", row_group_size=_ROWS)
    return bytes(sink.getvalue())
