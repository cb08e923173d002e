"""Prediction files as submissions to the leaderboard: rows, versions, licence and digest."""

from __future__ import annotations

import json
from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd

from physion.analysis.tables.csv_table import read_csv
from physion.analysis.tables.predictions import REQUIRED, check_predictions, name_models
from physion.core.errors import BadInputError
from physion.core.files import file_sha256

SIDECAR_KEYS = ("versions", "license")
"""What the JSON file next to a table of predictions may state."""


@dataclass(frozen=True)
class Submission:
    """A checked file of predictions.

    ``rows``: with ``agent``; ``versions``: of each model, as text; ``license``: of the file, as
    text; ``sha256``: hexadecimal digest of its bytes.
    """

    rows: pd.DataFrame
    versions: dict[str, str]
    license: str
    sha256: str


@dataclass(frozen=True)
class Filters:
    """Which models are on the leaderboard; empty: all.

    ``models``: parts of their names; ``readouts`` and ``trainings``: whole names. Upper and lower
    case are the same.
    """

    models: tuple[str, ...] = ()
    readouts: tuple[str, ...] = ()
    trainings: tuple[str, ...] = ()

    def apply(self, submission: Submission) -> Submission:
        """Return the submission with the rows of the chosen models; it may have none left."""
        rows = submission.rows
        name = rows["model"].str.lower()
        kept = pd.Series(True, index=rows.index)
        if self.models:
            kept &= name.map(lambda text: any(part.lower() in text for part in self.models))
        kept &= _is_one_of(rows["readout"], self.readouts)
        kept &= _is_one_of(rows["Dynamics Training Dataset"], self.trainings)
        return replace(submission, rows=rows[kept].reset_index(drop=True))


def _is_one_of(values: pd.Series, names: Collection[str]) -> pd.Series:
    if not names:
        return pd.Series(True, index=values.index)
    return values.fillna("").str.lower().isin([name.lower() for name in names])


def read_submission(path: Path) -> Submission:
    """Read and check a file of predictions; raise `BadInputError` with its fault."""
    raw = read_csv(path, REQUIRED)
    rows = name_models(check_predictions(raw, str(path)))
    stated = read_sidecar(path)
    versions = dict.fromkeys(map(str, rows["agent"].unique()), stated["versions"])
    if "Versions" in raw.columns:
        # The rows are still in the order of the file.
        words = raw["Versions"].fillna("").str.strip().reset_index(drop=True)
        found = words.groupby(rows["agent"].to_numpy()).agg(lambda each: "; ".join(sorted({*each})))
        versions |= {str(agent): text for agent, text in found.items() if text}
    return Submission(rows, versions, stated["license"], file_sha256(path))


def read_sidecar(path: Path) -> dict[str, str]:
    """Return the entries `SIDECAR_KEYS` of the JSON file next to a table of predictions.

    The file has the name of the table, with ``.json`` for or after its ending. Each entry is text,
    ``versions`` also an object of names and versions; empty without file or entry. Raises
    `BadInputError` for anything else.
    """
    for sidecar in (path.with_suffix(".json"), path.with_name(path.name + ".json")):
        if not sidecar.is_file():
            continue
        try:
            content = json.loads(sidecar.read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
            raise BadInputError(f"{sidecar} is not a JSON file: {error}") from error
        if not isinstance(content, dict):
            raise BadInputError(f"{sidecar}: must be an object with {' or '.join(SIDECAR_KEYS)}")
        stated = {key: content.get(key, "") for key in SIDECAR_KEYS}
        if isinstance(stated["versions"], dict):
            each = stated["versions"].items()
            stated["versions"] = ", ".join(f"{name} {version}" for name, version in each)
        for key, text in stated.items():
            if not isinstance(text, str):
                raise BadInputError(f"{sidecar}: {key!r} must be text")
        return stated
    return dict.fromkeys(SIDECAR_KEYS, "")
