"""Inputs of a report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import pandas as pd

from physion.analysis.compare import ComparisonResults, tidy_scores
from physion.analysis.model_tests import MixedTable
from physion.analysis.people.results import PeopleResults
from physion.analysis.results import results_table
from physion.analysis.scores import runs_table
from physion.analysis.tables import DETECTION

EXPECTED_METHODS = ("Engine", "Renderer", "Readout", "Encoder weights", "Noise of the simulation")
"""Settings made outside the analysis; those that the caller omits are printed as not stated."""


@dataclass(frozen=True)
class ReportInputs(ComparisonResults):
    """Results of a comparison with the settings of the page.

    - ``title``: the heading.
    - ``methods``: settings made outside the analysis, as text; absent ones of `EXPECTED_METHODS`
      are printed as not stated.
    - ``movies``: file by stimulus (mp4, webm, gif, png or jpg); other files are ignored.
    - ``question``: what people and models were asked, for the movies.
    - ``model_inputs``: what a model was given, by its name: values of the column *Inputs*.
    - ``model_weights``: which weights a model started from, by its name: of the column *Init*.
    - ``model_seen``: columns `results.SEEN` of the predictions, by model (index), or None.
    - ``published``: from `published_rows`, or None; ``zone``: from `zone_of_people`, or None.
    - ``rollout_errors``: from `rollout_error_table`, or None.
    - ``movie_count``: largest number of disagreements that are shown as movies.
    - ``page_bytes``: size of the page up to which movies are added; what does not fit is left out.
    - ``scatter_limit``: largest number of models in the scatter figure; the caption names the rest.
    """

    title: str = "Models and people on physical prediction"
    methods: Mapping[str, str] = field(default_factory=dict)
    movies: Mapping[str, Path] = field(default_factory=dict)
    question: str = "Will the agent touch the patient?"
    model_inputs: Mapping[str, str] = field(default_factory=dict)
    model_weights: Mapping[str, str] = field(default_factory=dict)
    model_seen: pd.DataFrame | None = None
    published: pd.DataFrame | None = None
    zone: tuple[tuple[float, float], tuple[float, float]] | None = None
    rollout_errors: pd.DataFrame | None = None
    movie_count: int = 8
    page_bytes: int = 15_000_000
    scatter_limit: int = 12

    @classmethod
    def of(cls, results: ComparisonResults, **settings: Any) -> ReportInputs:
        """Return the inputs for these results; ``settings`` are further fields."""
        return cls(**{one.name: getattr(results, one.name) for one in fields(results)}, **settings)

    @property
    def mark(self) -> str:
        """What stands at the top of every page, see `PeopleResults.mark`."""
        return "" if self.people is None else self.people.mark

    def scatter_models(self) -> list[str]:
        """The models of the figures next to people: the first ones, in the order of the
        predictions; not the readout that sees the outcome, if there is another."""
        stimuli = self.comparison.stimuli
        detecting = set(stimuli.loc[stimuli["readout"] == DETECTION, "model"])
        models = [name for name in self.comparison.models if name not in detecting]
        return models[: self.scatter_limit]

    def results(self) -> pd.DataFrame:
        """The table of results, see `results_table`."""
        scores = tidy_scores(self)
        return results_table(scores, self.model_inputs, self.published, self.model_seen)

    def tables(self) -> dict[str, pd.DataFrame]:
        """Every table by the name of its file."""
        comparison = self.comparison
        found: dict[str, pd.DataFrame | None] = {
            "results": self.results(),
            "comparison": self._with_init(self._against_people()),
            "comparison_later": self._with_init(comparison.later)
            if len(comparison.later)
            else None,
            "people": comparison.people,
            "stimuli": comparison.stimuli,
            "changed_outcomes": comparison.changed,
            "left_out": comparison.dropped,
            "accuracy_over_runs": runs if len(runs := runs_table(comparison.scores)) else None,
            "paired_tests": self.paired,
            "group_contrasts": self.contrasts,
            "comparison_with_flagged": None
            if self.comparison_all is None
            else self._with_init(self.comparison_all.all_scores),
        }
        if self.with_people is not None:
            found |= {
                "measures": self.with_people.scores,
                "zones": self.with_people.zones,
                "model_pairs": self.with_people.pairs,
                "left_out_with_people": self.with_people.dropped,
            }
        if self.population is not None:
            names = ("consensus", "agreement", "differences")
            found |= {f"population_{name}": getattr(self.population, name) for name in names}
        found |= _mixed_tables(self.mixed)
        if self.people is not None:
            found |= _people_tables(self.people)
        return {name: t for name, t in found.items() if t is not None and len(t.columns)}

    def _against_people(self) -> pd.DataFrame:
        """Return all scores with the columns of `against_people`, as `tidy_scores` has them."""
        table, columns = self.comparison.all_scores, ["reliably", "people_interval"]
        if not self.comparison.has_people:
            return table
        marks = tidy_scores(self).set_index(["model", "scenario"])[columns]
        return table.join(marks, on=["model", "scenario"])

    def _with_init(self, scores: pd.DataFrame) -> pd.DataFrame:
        """Return scores with the column ``init``, the weights of each model, after the readout."""
        init = [self.model_weights.get(str(model), "") for model in scores["base_model"]]
        table = scores.copy()
        table.insert(list(table.columns).index("readout") + 1, "init", init)
        return table


@dataclass(frozen=True)
class PeopleReport:
    """Results about people with the settings of their page, which needs no predictions.

    - ``people``: every analysis of them.
    - ``mixed``: from `fits_of_people`.
    - ``methods``: settings made outside the analysis, as text.
    - ``movies``: movie by stimulus, to which the page links.
    - ``title``: the heading.
    """

    people: PeopleResults
    mixed: tuple[MixedTable, ...] = ()
    methods: Mapping[str, str] = field(default_factory=dict)
    movies: Mapping[str, Path] = field(default_factory=dict)
    title: str = "People on physical prediction"

    def tables(self) -> dict[str, pd.DataFrame]:
        """Every table by the name of its file."""
        found = {**_mixed_tables(self.mixed), **_people_tables(self.people)}
        return {name: table for name, table in found.items() if len(table.columns)}


def _mixed_tables(fits: Sequence[MixedTable]) -> dict[str, pd.DataFrame]:
    return {f"mixed_{fit.name}": fit.table() for fit in fits}


def _people_tables(people: PeopleResults) -> dict[str, pd.DataFrame]:
    return {f"people_{name}": table for name, table in people.tables.items()}
