"""Inputs of a report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd

from physion.analysis.models.comparison import Comparison
from physion.analysis.models.people_comparison import PeopleComparison
from physion.report.mixed_fits import MixedTable
from physion.report.people_results import PeopleResults

EXPECTED_METHODS = ("Engine", "Renderer", "Readout", "Encoder weights", "Noise of the simulation")
"""Choices that are made outside the analysis; the page says so where the caller names none."""


def permutations_of(pairs: int) -> int:
    """Permutations for so many pairs of models: Holm's correction must be able to find something.

    The least p is one over their number, which the correction multiplies by that of the pairs.
    """
    return min(20_000, max(2_000, 40 * pairs))


@dataclass(frozen=True)
class ReportInputs:
    """All that a report is made of.

    - ``comparison``: from `physion.analysis.compare`.
    - ``title``: the heading.
    - ``methods``: choices made outside the analysis, in words; those of `EXPECTED_METHODS` that
      are absent are printed as not stated.
    - ``movies``: file by stimulus (mp4, webm, gif, png or jpg); others than are shown do no harm.
    - ``movie_count``, ``movie_bytes``: at most so many movies, and so many bytes of them in all.
    - ``scatter_limit``: at most so many models in the scatter figure; the caption names the rest.
    - ``predictions``: from `predictions.read_predictions`, for what needs readout and training.
    - ``people``: what single participants say; None: only their averages are known.
    - ``beside``: the models beside single people, from `people_comparison.compare_everywhere`.
    - ``comparison_all``: the comparison with all complete sessions, flagged ones too.
    - ``paired``: from `paired.compare_models`, all scenarios pooled.
    - ``calibration``: from `calibration.calibration_table`.
    - ``mixed``: from `mixed_fits`.
    """

    comparison: Comparison
    title: str = "Models and people on physical prediction"
    methods: Mapping[str, str] = field(default_factory=dict)
    movies: Mapping[str, Path] = field(default_factory=dict)
    movie_count: int = 8
    movie_bytes: int = 20_000_000
    scatter_limit: int = 12
    predictions: pd.DataFrame | None = None
    people: PeopleResults | None = None
    beside: PeopleComparison | None = None
    comparison_all: Comparison | None = None
    paired: pd.DataFrame | None = None
    calibration: pd.DataFrame | None = None
    mixed: tuple[MixedTable, ...] = ()

    def scatter_agents(self) -> list[str]:
        """The models of the scatter figure: the first ones, in the order of the predictions."""
        return self.comparison.agents[: self.scatter_limit]

    def tables(self) -> dict[str, pd.DataFrame]:
        """Every table by the name of its file."""
        own = self.comparison
        found: dict[str, pd.DataFrame | None] = {
            "comparison": own.scores,
            "people": own.people,
            "stimuli": own.stimuli,
            "changed_outcomes": own.changed,
            "left_out": own.dropped,
            "paired_tests": self.paired,
            "calibration_scores": self.calibration,
            "comparison_with_flagged": None
            if self.comparison_all is None
            else self.comparison_all.scores,
        }
        if self.beside is not None:
            found |= {
                "measures": self.beside.scores,
                "zones": self.beside.zones,
                "model_pairs": self.beside.pairs,
                "left_out_beside_people": self.beside.dropped,
            }
        for fit in self.mixed:
            found[f"mixed_{fit.name}"] = fit.table()
        if self.people is not None:
            found |= {f"people_{name}": table for name, table in self.people.tables.items()}
        return {name: t for name, t in found.items() if t is not None and len(t.columns)}
