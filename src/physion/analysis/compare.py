"""All results of a comparison, computed here so that the report only draws.

`all_results` is what `physion.compare` calls: scores of models by stimulus (`comparison`), models
with single participants (`compare_everywhere`), tests and mixed models.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from physion.analysis.comparison import Comparison, compare_scores
from physion.analysis.intervals import Bootstrap
from physion.analysis.model_tests import (
    MixedTable,
    fits_of_models,
    fits_of_people,
    group_contrasts,
    paired_tests,
    pool_comparison,
)
from physion.analysis.people.measures import accuracy_by_stimulus, all_answers, split_halves
from physion.analysis.people.results import PeopleResults
from physion.analysis.population import PopulationResults, compare_populations
from physion.analysis.scores import TWO_PEOPLE, against_people, with_kind
from physion.analysis.tables import DETECTION, check_excluded_names, name_models
from physion.analysis.with_participants import (
    add_baselines,
    human_zones,
    mean_measures,
    measure_models,
    measure_table,
    model_pairs,
    models_of,
    released_r_zone,
)
from physion.core.errors import BadInputError
from physion.core.tables import require_columns

# All models compared with all participants: every scenario, their mean, and what was excluded.


@dataclass(frozen=True)
class PeopleComparison:
    """Tables that compare models with single participants.

    - ``scores``: `measure_table` of every scenario, then of their mean with equal
      weights (NaN if one of them is undefined), with ``kind`` (model or baseline; the computed
      baselines come last in each scenario), ``zone_low``, ``zone_high`` (of single participants)
      and ``in_zone`` (yes, no, or empty if either is undefined or the model lacks some of the
      stimuli of the zone).
    - ``zones``: `human_zones` of every scenario, and for several scenarios also the paper's
      band of r (`released_r_zone`), whose scenario is the mean.
    - ``pairs``: `model_pairs` of every scenario.
    - ``dropped``: ``model``, ``scenario``, ``reason``, ``stimuli``.
    """

    scores: pd.DataFrame
    zones: pd.DataFrame
    pairs: pd.DataFrame
    dropped: pd.DataFrame


def compare_everywhere(
    predictions: pd.DataFrame,
    test: pd.DataFrame,
    bootstrap: Bootstrap | None = None,
) -> PeopleComparison:
    """Compare the models of ``predictions`` with the people of ``test`` in every scenario.

    Parameters
    ----------
    predictions
        One row per model and stimulus with ``model``, ``stimulus`` (canonical name), ``p_contact``,
        ``predicted``. Predictions of stimuli that nobody saw are counted as dropped.
    test
        Test rows of `Responses`. People and baselines are measured on all their stimuli.
    bootstrap
        Draws of participants, and the seed of the halves.
    """
    columns = ["model", "stimulus", "p_contact", "predicted"]
    require_columns(predictions, columns, "the predictions")
    draws = bootstrap or Bootstrap()
    scenario_by_stimulus = test.drop_duplicates("stimulus").set_index("stimulus")["scenario"]
    rows = predictions[columns].assign(scenario=predictions["stimulus"].map(scenario_by_stimulus))
    names = list(rows["model"].unique())
    dropped = [_unseen(rows)]
    measured, zones, pairs = [], [], []
    for answers in all_answers(test):
        subset = rows[rows["scenario"] == answers.scenario]
        models, unmatched = models_of(subset, answers, names)
        dropped.append(unmatched.assign(scenario=answers.scenario))
        measured.append(measure_models(add_baselines(models, answers), answers, TWO_PEOPLE, draws))
        zones.append(human_zones(answers, split_halves(answers.yes, seed=draws.seed)))
        pairs.append(model_pairs(models, answers).assign(scenario=answers.scenario))
    zone = pd.concat(zones, ignore_index=True)
    if len(measured) > 1:
        zone = pd.concat([zone, released_r_zone(zone)], ignore_index=True)
    tables = [measure_table(one) for one in measured]
    if len(measured) > 1:
        tables.append(measure_table(mean_measures(measured)))
    return PeopleComparison(
        scores=with_kind(_with_zone(pd.concat(tables, ignore_index=True), zone), "model"),
        zones=zone,
        pairs=pd.concat(pairs, ignore_index=True),
        dropped=pd.concat(dropped, ignore_index=True)[["model", "scenario", "reason", "stimuli"]],
    )


def _unseen(rows: pd.DataFrame) -> pd.DataFrame:
    counts = rows[rows["scenario"].isna()].groupby("model", sort=False).size()
    table = pd.DataFrame({"model": counts.index, "stimuli": counts.to_numpy()})
    return table.assign(scenario="unknown", reason="people did not see it")


def _with_zone(scores: pd.DataFrame, zones: pd.DataFrame) -> pd.DataFrame:
    subset = zones.loc[zones["of"] == "participants", ["scenario", "measure", "low", "high"]]
    subset = subset.rename(columns={"low": "zone_low", "high": "zone_high"})
    joined = scores.merge(subset, on=["scenario", "measure"], how="left")
    known = joined[["value", "zone_low", "zone_high"]].notna().all(axis=1)
    # The zone is of all stimuli of the scenario that any row has.
    known &= joined["stimuli"] == joined.groupby("scenario")["stimuli"].transform("max")
    inside = joined["value"].between(joined["zone_low"], joined["zone_high"])
    words = inside.map({True: "yes", False: "no"})
    return joined.assign(in_zone=words.where(known, ""))


@dataclass(frozen=True)
class ComparisonResults:
    """Results of a comparison of models with people.

    - ``comparison``: from `compare_scores`.
    - ``predictions``: from `read_predictions`, for what needs readout and training.
    - ``people``: results about single participants; None if only their averages are known.
    - ``with_people``: models and single participants, from `compare_everywhere`, without
      `DETECTION`.
    - ``comparison_all``: the comparison with all complete sessions, including flagged ones.
    - ``paired``: from `paired_tests`, all scenarios pooled; None for one model.
    - ``mixed``: from `fits_of_people` and `fits_of_models`.
    - ``contrasts``: from `group_contrasts`; None if no grouping was given.
    - ``population``: from `compare_populations`; None if not asked for.
    - ``warnings``: what may make the results wrong, one sentence each.
    """

    comparison: Comparison
    predictions: pd.DataFrame | None = None
    people: PeopleResults | None = None
    with_people: PeopleComparison | None = None
    comparison_all: Comparison | None = None
    paired: pd.DataFrame | None = None
    mixed: tuple[MixedTable, ...] = ()
    contrasts: pd.DataFrame | None = None
    population: PopulationResults | None = None
    warnings: tuple[str, ...] = ()


def all_results(
    predictions: pd.DataFrame,
    humans: pd.DataFrame | None = None,
    labels: Mapping[str, bool] | None = None,
    *,
    people: PeopleResults | None = None,
    zone: pd.DataFrame | None = None,
    zone_origin: str = "",
    groups: Sequence[str] = (),
    population: bool = False,
    exclude: Iterable[str] = (),
    exclude_ledge: bool = True,
    bootstrap: Bootstrap | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> ComparisonResults:
    """Compare models with people, and compute all that a report shows.

    Parameters
    ----------
    predictions
        From `read_predictions`.
    humans, labels, zone, zone_origin
        Averages of people, recorded outcomes and the human zone, as in `compare_scores`.
    people
        From `people.results.analyse_people`, in place of ``humans``, ``labels`` and ``zone``.
    groups
        Columns of ``predictions`` by which models are compared in groups.
    population
        Whether models of several seeds are compared as populations (`compare_populations`).
    exclude, exclude_ledge, bootstrap
        As in `compare_scores`.

    Returns
    -------
    results
        Scores by model and scenario with intervals, differences of models, mixed
        models, and, with ``people``, models next to single participants.

    Raises
    ------
    BadInputError
        For ``people`` together with averages, and as `compare_scores`.
    UnknownNameError
        For a name in ``exclude`` that no table contains.
    """
    draws = bootstrap or Bootstrap()
    settings: dict[str, Any] = {
        "exclude": tuple(exclude),
        "exclude_ledge": exclude_ledge,
        "bootstrap": draws,
    }
    predictions = name_models(predictions)
    predicted = set(predictions["stimulus"])
    whole, with_people, about_people = None, None, []
    if people is None:
        seen = set() if humans is None else set(humans["stimulus"])
        check_excluded_names(settings["exclude"], {*predicted, *seen, *(labels or {})})
        main = compare_scores(
            predictions, humans, labels, zone=zone, zone_origin=zone_origin, **settings
        )
    else:
        if humans is not None or labels is not None or zone is not None:
            raise BadInputError("give averages of people or their single responses, not both")
        check_excluded_names(settings["exclude"], predicted | people.stimuli)
        known, test = people.labels(), people.kept.test
        main = compare_scores(
            predictions,
            people.tables["by_stimulus"],
            known,
            zone=people.zone(),
            zone_origin="from the responses themselves",
            participants=True,
            **settings,
        )
        everybody = accuracy_by_stimulus(people.whole.test, draws)
        whole = compare_scores(predictions, everybody, known, **settings)
        predicting = main.stimuli[main.stimuli["readout"] != DETECTION]
        answered = test[test["stimulus"].isin(main.stimuli["stimulus"])]
        with_people = compare_everywhere(predicting, answered, draws)
        about_people = fits_of_people(people, progress)
    pooled = pool_comparison(main)
    several = len(main.names) > 1
    together = compare_populations(main, predictions) if population else None
    return ComparisonResults(
        main,
        predictions=predictions,
        people=people,
        with_people=with_people,
        comparison_all=whole,
        paired=paired_tests(pooled, draws) if several else None,
        mixed=(*about_people, *fits_of_models(main, predictions)),
        contrasts=group_contrasts(main, predictions, groups) if groups else None,
        population=together,
        warnings=(
            *(people.warnings if people else ()),
            *main.warnings,
            *(together.warnings if together else ()),
        ),
    )


def tidy_scores(results: ComparisonResults) -> pd.DataFrame:
    """Return people, models and baselines in one table: one row per model and scenario.

    Columns as `Comparison.all_scores`, with ``kind`` *people* for one person with another, who come
    first; ``kappa`` with its interval, which needs single participants; and ``interval``: what the
    intervals of the row are about, *people and stimuli*, or *stimuli* where only averages of people
    are known and in row `POOLED`; and the columns of `against_people`, empty in rows of people.
    """
    table = results.comparison.all_scores
    kind = table["kind"].mask(table["model"] == TWO_PEOPLE, "people")
    table = table.assign(kind=kind, kappa=np.nan, kappa_low=np.nan, kappa_high=np.nan)
    table["interval"] = "stimuli"
    if results.with_people is not None:
        keys = pd.MultiIndex.from_frame(table[["model", "scenario"]])
        measures = results.with_people.scores.set_index(["model", "scenario"])
        table["interval"] = np.where(keys.isin(measures.index), "people and stimuli", "stimuli")
        for name, rows in measures.groupby("measure"):
            if f"{name}_low" not in table:
                continue
            own = rows.reindex(keys)
            known = keys.isin(rows.index)
            given = {name: "value", f"{name}_low": "low_both", f"{name}_high": "high_both"}
            for column, of in given.items():
                table[column] = np.where(known, own[of].to_numpy(np.float64), table[column])
    if results.comparison.has_people:
        table = against_people(table, results.comparison.people)
        table.loc[table["kind"] == "people", ["reliably", "people_interval"]] = ""
    rank = table["kind"].map({"people": 0, "model": 1, "baseline": 2})
    return table.iloc[np.argsort(rank.to_numpy(), kind="stable")].reset_index(drop=True)
