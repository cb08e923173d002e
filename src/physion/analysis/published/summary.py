"""Published results of the original study, recomputed from its released tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from physion.analysis.published.cells import accuracy_table, describe_averages
from physion.analysis.published.panels import SELECTION, panel_a, panel_c, panel_d, panel_e
from physion.analysis.published.people import people_by_scenario, people_claims
from physion.analysis.published.regressions import published_regressions
from physion.analysis.published.supplement import (
    NOT_MADE,
    accuracy_and_kappa,
    figure_s1,
    figure_s3,
)
from physion.analysis.published.tables import PublishedTables, read_published
from physion.analysis.statistics.bootstrap import Bootstrap

TITLES = {
    "accuracies": "Accuracy of models by scenario: as published, and trained on all scenarios with "
    "readout observed+simulated",
    "panel_a": "Panel A: accuracy",
    "panel_c": "Panel C: Cohen's kappa with participants",
    "panel_d": "Panel D: accuracy by readout",
    "panel_e": "Panel E: accuracy by training",
    "accuracy_kappa": "How kappa with participants follows accuracy",
    "figure_s1": "Figure S1, top: accuracy of people by stimulus",
    "figure_s3": "Figure S3: accuracy of DPI and of people by scenario",
    "not_made": "Figures that the released tables do not determine",
    "regressions": "Regressions of the Results section",
    "people": "People by scenario",
    "people_claims": "What the paper says of people",
    "left_out": "Rows left out",
}
"""The tables in the order in which a report shows them."""

REGRESSIONS = (
    "Linear mixed models of accuracy, REML, degrees of freedom by Satterthwaite, as the released "
    "notebook has them. “run” is what the printed number was computed from; “once” the same with "
    "each released row once; “asked” what the sentence says, each row once. Rows of one model and "
    "scenario that differ in readout or seed share their test stimuli and are not independent, "
    "which none of these models knows: their p are too small."
)

ACCURACY_KAPPA = (
    "The paper says that kappa is strongly correlated with accuracy, without a number. Pearson's "
    "r over the cells of panels A and C; intervals draw models with all of their scenarios. Kappa "
    "with people is bound to rise with accuracy where people are mostly right, so this r is no "
    "sign of likeness beyond the outcome."
)


@dataclass(frozen=True)
class PublishedResults:
    """Results: ``tables`` by the names of `TITLES`, and their ``descriptions``."""

    tables: Mapping[str, pd.DataFrame]
    descriptions: Mapping[str, str]


def published_results(folder: Path, bootstrap: Bootstrap | None = None) -> PublishedResults:
    """Recompute all results from the official data in ``folder`` (``results/`` and ``humans/``).

    Raises `BadInputError` for missing or invalid files.
    """
    return results_of(read_published(folder), bootstrap)


def results_of(released: PublishedTables, bootstrap: Bootstrap | None = None) -> PublishedResults:
    """Recompute all results from tables that are already read."""
    draws = bootstrap or Bootstrap()
    tables = {
        "accuracies": accuracy_table(released, draws),
        "panel_a": panel_a(released, draws),
        "panel_c": panel_c(released, draws),
        "panel_d": panel_d(released, draws),
        "panel_e": panel_e(released, draws),
        "accuracy_kappa": accuracy_and_kappa(released, draws),
        "figure_s1": figure_s1(released),
        "figure_s3": figure_s3(released, draws),
        "not_made": pd.DataFrame(list(NOT_MADE.items()), columns=["figure", "reason"]),
        "regressions": published_regressions(released),
        "people": people_by_scenario(released, draws),
        "people_claims": people_claims(released),
        "left_out": released.dropped,
    }
    descriptions = {
        "accuracies": describe_averages(released)
        + f" Intervals: {draws.level:.0%}, of a published value a bootstrap over the rows that it "
        "averages, and next to it by the paper's way, which draws the rows of the whole table, "
        "ungrouped; of the expected cell Wilson's for the stimuli tested.",
        "panels": SELECTION,
        "accuracy_kappa": ACCURACY_KAPPA,
        "regressions": REGRESSIONS,
        "people": "Accuracy, kappa and split-half r from the released tables by scenario; kappa is "
        "the median over pairs; split-half r is of halves (half_r_full: stepped up to all people). "
        "Counts and accuracy_by_stimulus are from the tables by stimulus, whose exclusion is laxer "
        "by up to eight people.",
    }
    return PublishedResults(tables, descriptions)
