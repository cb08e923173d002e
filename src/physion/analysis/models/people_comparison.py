"""All models compared with all participants: every scenario, their mean, and what was excluded."""

from __future__ import annotations

from dataclasses import dataclass

import pandas as pd

from physion.analysis.models.anchors import TWO_PEOPLE, add_anchors, with_kind
from physion.analysis.models.measures import mean_measures, measure_models, measure_table
from physion.analysis.models.model_people import model_pairs, models_of
from physion.analysis.models.model_tests import calibration_scores, paired_tests, pool_scenarios
from physion.analysis.models.paired_measures import paired_measures
from physion.analysis.models.zones import human_zones, released_r_zone
from physion.analysis.people.people import HALVES, all_answers, split_halves
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.tables.csv_table import require_columns


@dataclass(frozen=True)
class PeopleComparison:
    """Tables that compare models with single participants.

    - ``scores``: `measures.measure_table` of every scenario, then of their mean with equal
      weights (NaN if one of them is undefined), with ``kind`` (model or anchor; the computed
      anchors come last in each scenario), ``zone_low``, ``zone_high`` (of single participants) and
      ``in_zone`` (yes, no, or empty if either is undefined).
    - ``zones``: `zones.human_zones` of every scenario, and for several scenarios also the paper's
      band of r (`zones.released_r_zone`), whose scenario is the mean.
    - ``pairs``: `model_people.model_pairs` of every scenario.
    - ``tests``: `paired.compare_models` on the stimuli of all scenarios together;
      ``measure_tests``: `paired_measures.paired_measures`.
    - ``calibration``: `calibration.calibration_table`, likewise.
    - ``dropped``: ``agent``, ``scenario``, ``reason``, ``stimuli``.
    """

    scores: pd.DataFrame
    zones: pd.DataFrame
    pairs: pd.DataFrame
    tests: pd.DataFrame
    measure_tests: pd.DataFrame
    calibration: pd.DataFrame
    dropped: pd.DataFrame


def compare_everywhere(
    predictions: pd.DataFrame,
    test: pd.DataFrame,
    bootstrap: Bootstrap | None = None,
    *,
    halves: int = HALVES,
    permutations: int = 2000,
) -> PeopleComparison:
    """Compare the models of ``predictions`` with the people of ``test`` in every scenario.

    Parameters
    ----------
    predictions
        One row a model and stimulus with ``agent``, ``stimulus`` (canonical name), ``p_contact``,
        ``predicted``. Predictions of stimuli that nobody saw are counted as dropped.
    test
        Test rows of `participants.Responses`.
    bootstrap
        Level of the intervals, and draws of the tests.
    halves
        Number of random splits of the people into halves.
    permutations
        Permutations of the test of differences in r.
    """
    columns = ["agent", "stimulus", "p_contact", "predicted"]
    require_columns(predictions, columns, "the predictions")
    draws = bootstrap or Bootstrap()
    scenario_by_stimulus = test.drop_duplicates("stimulus").set_index("stimulus")["scenario"]
    rows = predictions[columns].assign(scenario=predictions["stimulus"].map(scenario_by_stimulus))
    agents = list(rows["agent"].unique())
    dropped = [_unseen(rows)]
    measured, scored, zones, pairs = [], [], [], []
    for answers in all_answers(test):
        subset = rows[rows["scenario"] == answers.scenario]
        models, unmatched = models_of(subset, answers, agents)
        dropped.append(unmatched.assign(scenario=answers.scenario))
        scored.append((models, answers))
        measured.append(
            measure_models(add_anchors(models, answers), answers, two_people=TWO_PEOPLE)
        )
        zones.append(human_zones(answers, split_halves(answers.yes, halves, draws.seed)))
        pairs.append(model_pairs(models, answers).assign(scenario=answers.scenario))
    zone = pd.concat(zones, ignore_index=True)
    if len(measured) > 1:
        zone = pd.concat([zone, released_r_zone(zone)], ignore_index=True)
    tables = [measure_table(one, draws.level) for one in measured]
    if len(measured) > 1:
        tables.append(measure_table(mean_measures(measured), draws.level))
    pooled = pool_scenarios(scored)
    return PeopleComparison(
        scores=with_kind(_with_zone(pd.concat(tables, ignore_index=True), zone), "model"),
        zones=zone,
        pairs=pd.concat(pairs, ignore_index=True),
        tests=paired_tests(pooled, draws, permutations),
        measure_tests=paired_measures(pooled, draws.level, permutations, draws.seed),
        calibration=calibration_scores(pooled),
        dropped=pd.concat(dropped, ignore_index=True)[["agent", "scenario", "reason", "stimuli"]],
    )


def _unseen(rows: pd.DataFrame) -> pd.DataFrame:
    counts = rows[rows["scenario"].isna()].groupby("agent", sort=False).size()
    table = pd.DataFrame({"agent": counts.index, "stimuli": counts.to_numpy()})
    return table.assign(scenario="unknown", reason="people did not see it")


def _with_zone(scores: pd.DataFrame, zones: pd.DataFrame) -> pd.DataFrame:
    subset = zones.loc[zones["of"] == "participants", ["scenario", "measure", "low", "high"]]
    subset = subset.rename(columns={"low": "zone_low", "high": "zone_high"})
    joined = scores.merge(subset, on=["scenario", "measure"], how="left")
    known = joined[["value", "zone_low", "zone_high"]].notna().all(axis=1)
    inside = joined["value"].between(joined["zone_low"], joined["zone_high"])
    words = inside.map({True: "yes", False: "no"})
    return joined.assign(in_zone=words.where(known, ""))
