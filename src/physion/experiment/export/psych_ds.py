"""A study's tables as a Psych-DS dataset: CSV files under ``data/`` and schema.org metadata.

Psych-DS (psych-ds.github.io): ``dataset_description.json`` is a schema.org ``Dataset`` whose
``variableMeasured`` names every column of every file; data files are called
``keyword-value[_keyword-value...]_data.csv``.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from physion.analysis.people.response_schema import Column
from physion.experiment.export.column_words import KIND_WORDS, label_of, levels_of

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
    """Write a dataset into the new ``folder``; the data files.

    ``tables``: by a word of letters, a CSV file (copied) and its columns. ``name`` and
    ``description``: of the study. ``covers``: first and last moment of the data, in ISO 8601.
    """
    data = folder / "data"
    data.mkdir(parents=True)
    paths = []
    for word, (source, _) in tables.items():
        paths.append(data / f"study-{label_of(name)}_description-{label_of(word)}_data.csv")
        shutil.copyfile(source, paths[-1])
    columns: dict[str, Column] = {}
    for _, listed in tables.values():
        for column in listed:
            columns.setdefault(column.name, column)  # the first table says it in full
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
    """A column as a schema.org ``PropertyValue``."""
    about = f"{column.about} ({KIND_WORDS[column.kind]})"
    found: dict[str, Any] = {
        "@type": "PropertyValue",
        "name": column.name,
        "description": about,
    }
    if column.unit:
        found["unitText"] = column.unit
    if column.low is not None:
        found["minValue"] = column.low
    if column.high is not None:
        found["maxValue"] = column.high
    if levels_of(column):
        found["valueReference"] = list(levels_of(column))
    return found
