"""Tables of a dataset for `datasets.load_dataset`: one parquet file for each split.

``index`` has the rows of the index; ``videos`` has what may be seen of a trial, with the observed
movie itself as a column of the type ``Video``. The front matter of the card names the files by
split, because the library otherwise gives all rows as training rows, with the labels of the tests.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from physion.core.errors import BadInputError
from physion.core.files import check_digest, folder_for_writing, write_atomic
from physion.core.names import NAMES
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


# Tables of predictions with the names of scenarios that the notebooks of the study use.
#
# The columns of our tables are the official ones; the scenarios in them have our names
# (``collide``), while the notebooks select ``collision``, ``containment``, ``clothiness``,
# ``linking``, ``rollingsliding`` and ``towers`` (``change_names`` in ``physion/metrics.py`` of
# physics-models).

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
