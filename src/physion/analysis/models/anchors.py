"""Anchors of the tables of results: what a model's score is worth.

Three are computed from the answers of people and the official outcomes, without a model:

- `OUTCOME`: answers with the official outcome, as a perfect simulator would;
- `MAJORITY`: answers as most people did (no where they are divided equally): no answer of yes or no
  agrees with single people more often, so its kappa is the ceiling of models;
- `TWO_PEOPLE`: one person in place of the model, compared with another one.

Others come as predictions of models whose names are in `ANCHOR_MODELS`.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import pandas as pd

from physion.analysis.models.model_people import Models
from physion.analysis.models.score_tables import score_table, two_people_table
from physion.analysis.people.answers import ScenarioAnswers
from physion.analysis.statistics.bootstrap import Bootstrap

OUTCOME = "recorded outcome"
MAJORITY = "majority of people"
TWO_PEOPLE = "one person with another"
COMPUTED = (OUTCOME, MAJORITY, TWO_PEOPLE)
"""Names of the anchors that need no predictions."""

ANCHOR_MODELS = frozenset(
    {
        "outcome",
        "majority-of-people",
        "state-classifier",
        "already-touched",
        "constant-motion",
        "blob-centroids",
        "copy-last-frame",
        "chance",
    }
)
"""Names of models whose predictions are anchors."""

Kind = Literal["model", "anchor"]


def kind_of(agent: str) -> Kind:
    """Return whether an agent is a model or an anchor, by the name of the model alone."""
    model = agent.partition(" · ")[0]
    return "anchor" if model in ANCHOR_MODELS or agent in COMPUTED else "model"


def anchor_stimuli(stimuli: pd.DataFrame) -> pd.DataFrame:
    """Return the answers of `OUTCOME` and `MAJORITY` to the stimuli that people answered.

    ``stimuli`` and the result have the columns of `comparison.Comparison.stimuli`; the result is
    about each stimulus once, and P(contact) is 0 or 1. It is empty without people.
    """
    seen = stimuli[stimuli["p_yes"].notna()].drop_duplicates("stimulus")
    answers = {OUTCOME: seen["label"].astype(bool), MAJORITY: seen["p_yes"] > 0.5}
    parts = [
        seen.assign(agent=name, model=name, readout="", predicted=yes, p_contact=yes.astype(float))
        for name, yes in answers.items()
    ]
    table = pd.concat(parts, ignore_index=True)
    return table.assign(gap=table["p_contact"] - table["p_yes"])


def anchor_scores(stimuli: pd.DataFrame, bootstrap: Bootstrap) -> pd.DataFrame:
    """Return `with_kind` of the scores of the computed anchors; empty without people.

    ``stimuli``: as for `anchor_stimuli`.
    """
    answers = anchor_stimuli(stimuli)
    if answers.empty:
        return pd.DataFrame()
    people = answers[answers["agent"] == OUTCOME].assign(agent=TWO_PEOPLE, model=TWO_PEOPLE)
    parts = [score_table(answers, bootstrap), two_people_table(people, bootstrap)]
    return with_kind(pd.concat(parts, ignore_index=True))


def with_kind(scores: pd.DataFrame, names: str = "agent") -> pd.DataFrame:
    """Return a table with the column ``kind`` after that of the names of models."""
    table = scores.copy()
    kinds = [kind_of(str(name)) for name in scores[names]]
    table.insert(list(table.columns).index(names) + 1, "kind", kinds)
    return table


def add_anchors(models: Models, answers: ScenarioAnswers) -> Models:
    """Return the models with `OUTCOME` and `MAJORITY` as the last two."""
    rows = np.vstack([answers.label, answers.p_yes() > 0.5]).astype(np.float64)
    return Models(
        (*models.names, OUTCOME, MAJORITY),
        np.vstack([models.p_contact, rows]),
        np.vstack([models.predicted, rows]),
    )
