"""All results of a comparison, computed here so that the report only draws."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from physion.analysis.models.comparison import Comparison, compare_scores
from physion.analysis.models.mixed_fits import MixedTable, fits_of_models, fits_of_people
from physion.analysis.models.model_tests import (
    calibration_scores,
    paired_tests,
    permutations_of,
    pool_comparison,
)
from physion.analysis.models.paired_measures import paired_measures
from physion.analysis.models.people_comparison import PeopleComparison, compare_everywhere
from physion.analysis.people.people import accuracy_by_stimulus
from physion.analysis.people.results import PeopleResults
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.tables.stimuli import check_excluded_names
from physion.core.errors import BadInputError


@dataclass(frozen=True)
class ComparisonResults:
    """Results of a comparison of models with people.

    - ``comparison``: from `comparison.compare_scores`.
    - ``predictions``: from `predictions.read_predictions`, for what needs readout and training.
    - ``people``: results about single participants; None if only their averages are known.
    - ``beside``: models and single participants, from `people_comparison.compare_everywhere`.
    - ``comparison_all``: the comparison with all complete sessions, including flagged ones.
    - ``paired``: from `model_tests.paired_tests`, all scenarios pooled; None for one model.
    - ``paired_measures``: from `paired_measures.paired_measures`; None for one model or no people.
    - ``calibration``: from `model_tests.calibration_scores`.
    - ``mixed``: from `mixed_fits`.
    - ``warnings``: what may make the results wrong, one sentence each.
    """

    comparison: Comparison
    predictions: pd.DataFrame | None = None
    people: PeopleResults | None = None
    beside: PeopleComparison | None = None
    comparison_all: Comparison | None = None
    paired: pd.DataFrame | None = None
    paired_measures: pd.DataFrame | None = None
    calibration: pd.DataFrame | None = None
    mixed: tuple[MixedTable, ...] = ()
    warnings: tuple[str, ...] = ()


def compare(
    predictions: pd.DataFrame,
    humans: pd.DataFrame | None = None,
    labels: Mapping[str, bool] | None = None,
    *,
    people: PeopleResults | None = None,
    zone: pd.DataFrame | None = None,
    zone_origin: str = "",
    exclude: Iterable[str] = (),
    exclude_ledge: bool = True,
    bootstrap: Bootstrap | None = None,
) -> ComparisonResults:
    """Compare models with people, and compute all that a report shows.

    Parameters
    ----------
    predictions
        From `predictions.read_predictions`.
    humans, labels, zone, zone_origin
        Averages of people, recorded outcomes and the human zone, as in `compare_scores`.
    people
        From `people.results.analyse_people`, in place of ``humans``, ``labels`` and ``zone``.
    exclude, exclude_ledge, bootstrap
        As in `compare_scores`.

    Returns
    -------
    results
        Scores by model and scenario with intervals, differences of models, calibration, mixed
        models, and, with ``people``, models next to single participants.

    Raises
    ------
    BadInputError
        For ``people`` beside averages, and as `compare_scores`.
    UnknownNameError
        For a name in ``exclude`` that no table contains.
    """
    draws = bootstrap or Bootstrap()
    settings: dict[str, Any] = {
        "exclude": tuple(exclude),
        "exclude_ledge": exclude_ledge,
        "bootstrap": draws,
    }
    column = "stimulus" if "stimulus" in predictions else "Stimulus Name"
    predicted = set(predictions[column].astype(str))
    if people is not None:
        if humans is not None or labels is not None or zone is not None:
            raise BadInputError("give averages of people or their single responses, not both")
        check_excluded_names(settings["exclude"], predicted | people.stimuli)
        return _with_participants(predictions, people, draws, settings)
    seen = set() if humans is None else set(humans["stimulus"])
    check_excluded_names(settings["exclude"], {*predicted, *seen, *(labels or {})})
    comparison = compare_scores(
        predictions, humans, labels, zone=zone, zone_origin=zone_origin, **settings
    )
    return _with_averages(comparison, predictions, draws)


def _with_averages(
    comparison: Comparison, predictions: pd.DataFrame, draws: Bootstrap
) -> ComparisonResults:
    """Complete a comparison with people's averages, or without people, by tests and fits."""
    pooled = pool_comparison(comparison)
    several = len(comparison.agents) > 1
    return ComparisonResults(
        comparison,
        predictions=predictions,
        paired=paired_tests(pooled, draws) if several else None,
        paired_measures=paired_measures(pooled, draws.level, seed=draws.seed)
        if several and comparison.has_people
        else None,
        calibration=calibration_scores(pooled),
        mixed=tuple(fits_of_models(comparison)),
        warnings=comparison.warnings,
    )


def _with_participants(
    predictions: pd.DataFrame,
    people: PeopleResults,
    draws: Bootstrap,
    settings: Mapping[str, Any],
) -> ComparisonResults:
    """Compare models with the sessions that are not flagged, and with all complete ones.

    ``settings`` are the options of `compare_scores`, which resamples with ``draws``.
    """
    main = compare_scores(
        predictions,
        people.tables["by_stimulus"],
        people.labels(),
        zone=people.zone(),
        zone_origin="from the responses themselves",
        participants=True,
        **settings,
    )
    everybody = accuracy_by_stimulus(people.whole.test, draws)
    whole = compare_scores(predictions, everybody, people.labels(), **settings)
    agents = len(main.agents)
    permutations = permutations_of(agents * (agents - 1) // 2)
    beside = compare_everywhere(main.stimuli, people.kept.test, draws, permutations=permutations)
    return ComparisonResults(
        main,
        predictions=predictions,
        people=people,
        comparison_all=whole,
        beside=beside,
        paired=beside.tests if agents > 1 else None,
        paired_measures=beside.measure_tests if agents > 1 else None,
        calibration=beside.calibration,
        mixed=(*fits_of_people(people), *fits_of_models(main)),
        warnings=(*people.warnings, *main.warnings),
    )
