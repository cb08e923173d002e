"""DatasetFacts about a dataset, for its card and its metadata.

Every statement is computed from the index, read from the settings of the dataset, or true of all
datasets that this package makes.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from physion.errors import BadInputError
from physion.sealed import read_sealed
from physion.trials.columns import FILES, INDEX_COLUMNS
from physion.trials.index import read_index
from physion.trials.layout import INDEX, SETTINGS

SPLIT_MEANINGS = {
    "training": "for a model's own training",
    "readout": "for fitting a readout on a model's features",
    "testing": "for the test that models and people take",
    "familiarization": "for people to practise on",
}
SCENARIO_MEANINGS = {
    "collide": "one object is thrown at another",
    "contain": "objects lie in a bowl or round a post, and something is thrown at them",
    "dominoes": "a row of upright objects topples",
    "drape": "a cloth falls over things that stand in its way",
    "drop": "one object falls on another",
    "link": "rings hang on a post, and something is thrown at them",
    "roll": "an object rolls or slides down a ramp or off a ledge",
    "support": "a stack of objects stands or falls",
}


@dataclass(frozen=True)
class DatasetFacts:
    """Index of a dataset with size and SHA-256 of its file, and the settings of the dataset.

    ``settings`` is empty if the folder has none.
    """

    index: pd.DataFrame
    index_bytes: int
    index_sha256: str
    settings: dict[str, Any]

    @property
    def name(self) -> str:
        """Name of the dataset; several names are joined by ``+``."""
        return "+".join(sorted(set(self.index["dataset"])))

    @property
    def imported(self) -> int:
        """Number of trials whose scenes were imported, not sampled."""
        return int(self.index["seed"].isna().sum())

    @property
    def movies(self) -> int:
        """Number of trials with movies."""
        return int(self.index["movie"].notna().sum())

    def versions(self, column: str) -> str:
        """Return the distinct values of a column as one text."""
        return ", ".join(sorted({str(value) for value in self.index[column].dropna()}))

    def total_bytes(self) -> int:
        """Return the total size in bytes of all files in the index."""
        return int(self.index[[f"{name}_bytes" for name in FILES]].sum().sum())

    def collection(self) -> str:
        """Return how the trials were made."""
        drawn = len(self.index) - self.imported
        parts = []
        if drawn:
            parts.append(
                f"{drawn} {_scenes(drawn)} sampled at random by {self.versions('package')}."
            )
        if self.imported:
            parts.append(
                f"{self.imported} {_scenes(self.imported)} imported from records made elsewhere."
            )
        parts.append(
            f"All were simulated by {self.versions('engine')} and rendered by "
            f"{self.versions('renderer')}."
        )
        return " ".join(parts)

    def missing(self) -> str:
        """Return the numbers of missing cells of the index, by column."""
        columns = [name for name in INDEX_COLUMNS if not name.endswith(("_bytes", "_sha256"))]
        counts = self.index[columns].isna().sum()
        gaps = [f"{name} ({count})" for name, count in counts.items() if count]
        return f"Missing cells by column, of {len(self.index)}: {', '.join(gaps) or 'none'}."

    def biases(self) -> list[str]:
        """Return the known biases, with counts."""
        index = self.index
        rates = index.groupby("split", observed=True)["contact"].agg(["mean", "size"])
        statements = [
            f"Agent and patient touch in {row['mean']:.3f} of the {row['size']:.0f} {split} trials."
            for split, row in rates.iterrows()
        ]
        chosen = {
            name: self.settings[name]
            for name in ("min_visible", "robust", "observed_contact")
            if name in self.settings
        }
        if chosen and self.imported < len(index):
            text = ", ".join(f"{name} = {value}" for name, value in chosen.items())
            statements.append(
                f"Sampled trials were chosen with these settings of `physion generate`: {text}."
            )
        statements.append(
            "Shapes, sizes, colours, rooms and cameras follow the package's samplers or the "
            "imported scenes, not the statistics of any real place."
        )
        return statements

    def limitations(self) -> list[str]:
        """Return the known limitations, with counts."""
        index, n = self.index, len(self.index)
        statements = [
            "Rigid bodies and cloth are simulated; another engine may give some trials another "
            "outcome.",
            "The camera never moves, and there is no sound.",
            f"In {int(index['observed_contact'].sum())} of {n} trials agent and patient touch "
            "already in the observed part.",
        ]
        robust = index["robust"].dropna()
        if len(robust):
            statements.append(
                "Jittered simulations agree with the label in "
                f"{float(robust.mean()):.3f} of cases, measured on {len(robust)} of {n} trials."
            )
        else:
            statements.append(
                "How much labels depend on tiny changes of the scene was not measured."
            )
        unfinished = int((~index["completed"]).sum())
        statements.append(f"In {unfinished} of {n} trials something still moved at the time limit.")
        return statements


def read_facts(folder: Path) -> DatasetFacts:
    """Read the facts of a dataset; `BadInputError` if it has no index or no trial."""
    index = read_index(folder)
    if index.empty:
        raise BadInputError(f"{folder} has no trial to describe")
    data = (folder / INDEX).read_bytes()
    path, settings = folder / SETTINGS, {}
    if path.is_file():
        try:
            settings = dict(read_sealed(path)["settings"])
        except (KeyError, TypeError, ValueError) as error:
            raise BadInputError(f"{path} is damaged: field 'settings' is missing") from error
    return DatasetFacts(index, len(data), hashlib.sha256(data).hexdigest(), settings)


def _scenes(count: int) -> str:
    return "scene was" if count == 1 else "scenes were"
