"""Export of a study as a Psych-DS dataset: CSV files in ``data/`` and schema.org metadata.

Psych-DS (psych-ds.github.io): ``dataset_description.json`` is a schema.org ``Dataset`` whose
``variableMeasured`` describes every column of every file; data files are called
``keyword-value[_keyword-value...]_data.csv``.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from physion.analysis.people.responses import Column
from physion.experiment.export.conventions.column_labels import (
    KIND_NAMES,
    column_levels,
    file_label,
)

VERSION = "Psych-DS 0.4.0"


def write_psych_ds(
    folder: Path,
    tables: Mapping[str, tuple[Path, Sequence[Column]]],
    *,
    name: str,
    description: str,
    readme: str,
    covers: tuple[str, str] | None,
) -> list[Path]:
    """Write a dataset into a new folder; return the paths of its data files.

    Parameters
    ----------
    folder
        Folder to create.
    tables
        CSV file (which is copied) and columns of each table, by table name.
    name, description
        Name and title of the study.
    readme
        Text of README.md.
    covers
        First and last time in the data (ISO 8601), if known.
    """
    data = folder / "data"
    data.mkdir(parents=True)
    paths = []
    for table, (source, _) in tables.items():
        paths.append(data / f"study-{file_label(name)}_description-{file_label(table)}_data.csv")
        shutil.copyfile(source, paths[-1])
    columns: dict[str, Column] = {}
    for _, listed in tables.values():
        for column in listed:
            columns.setdefault(column.name, column)  # the first table has the full description
    metadata: dict[str, Any] = {
        "@context": "https://schema.org/",
        "@type": "Dataset",
        "name": name,
        "description": description,
        "schemaVersion": VERSION,
        "keywords": ["intuitive physics", "human behavior", "response time"],
        "variableMeasured": [variable(column) for column in columns.values()],
    }
    if covers is not None:
        metadata["temporalCoverage"] = "/".join(covers)
    text = json.dumps(metadata, indent=2, ensure_ascii=False)
    (folder / "dataset_description.json").write_text(text + "\n", encoding="utf-8")
    (folder / "README.md").write_text(readme, encoding="utf-8")
    return paths


def variable(column: Column) -> dict[str, Any]:
    """Return the description of a column as a schema.org ``PropertyValue``."""
    about = f"{column.about} ({KIND_NAMES[column.kind]})"
    value: dict[str, Any] = {
        "@type": "PropertyValue",
        "name": column.name,
        "description": about,
    }
    if column.unit:
        value["unitText"] = column.unit
    if column.low is not None:
        value["minValue"] = column.low
    if column.high is not None:
        value["maxValue"] = column.high
    if column_levels(column):
        value["valueReference"] = list(column_levels(column))
    return value
