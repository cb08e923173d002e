"""Anchors of the tables of results: what a model's score is worth.

Three are computed from the answers of people and the official outcomes, without a model:

- `OUTCOME`: answers with the official outcome, as a perfect simulator would;
- `MAJORITY`: answers as most people did (no where they are divided equally): no answer of yes or no
  agrees with single people more often, so its kappa is the ceiling of models;
- `TWO_PEOPLE`: one person in place of the model, compared with another one.

Others come as predictions of models whose names are in `ANCHOR_MODELS`. Predictions of `outcome` or
`majority-of-people` take the place of the computed anchor, which then stands in no table.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

import numpy as np
import pandas as pd

from physion.analysis.models.model_people import Models
from physion.analysis.models.score_tables import score_table, two_people_table
from physion.analysis.people.answers import ScenarioAnswers

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

GIVEN_AS = {OUTCOME: "outcome", MAJORITY: "majority-of-people"}
"""Names of the models whose predictions take the place of a computed anchor."""

Kind = Literal["model", "anchor"]


def kind_of(agent: str) -> Kind:
    """Return whether an agent is a model or an anchor, by the name of the model alone."""
    model = agent.partition(" · ")[0]
    return "anchor" if model in ANCHOR_MODELS or agent in COMPUTED else "model"


def not_given(agents: Iterable[str]) -> list[str]:
    """Return those of `OUTCOME` and `MAJORITY` of which no predictions were given.

    ``agents``: names of everything of which there are predictions.
    """
    models = {agent.partition(" · ")[0] for agent in agents}
    return [name for name, model in GIVEN_AS.items() if model not in models]


def seen_stimuli(stimuli: pd.DataFrame) -> pd.DataFrame:
    """Return each stimulus that people answered once, as rows of `TWO_PEOPLE`.

    ``stimuli`` and the result have the columns of `comparison.Comparison.stimuli`; the predictions
    are the outcomes and mean nothing. It is empty without people.
    """
    seen = stimuli[stimuli["p_yes"].notna()].drop_duplicates("stimulus")
    return _answering(seen, TWO_PEOPLE, seen["label"].astype(bool))


def anchor_stimuli(stimuli: pd.DataFrame) -> pd.DataFrame:
    """Return the answers of `OUTCOME` and `MAJORITY` to the stimuli that people answered.

    ``stimuli`` and the result have the columns of `comparison.Comparison.stimuli`; the result is
    about each stimulus once, and P(contact) is 0 or 1. Without people, and for anchors whose
    predictions were given (`GIVEN_AS`), it has no rows.
    """
    seen = seen_stimuli(stimuli)
    answers = {OUTCOME: seen["label"].astype(bool), MAJORITY: seen["p_yes"] > 0.5}
    names = not_given(str(agent) for agent in stimuli["agent"].unique())
    parts = [_answering(seen, name, answers[name]) for name in names]
    return pd.concat(parts, ignore_index=True) if parts else seen.iloc[:0]


def _answering(seen: pd.DataFrame, name: str, yes: pd.Series) -> pd.DataFrame:
    """Return the rows of ``seen`` with the answers ``yes`` of an anchor."""
    table = seen.assign(
        agent=name, model=name, readout="", predicted=yes, p_contact=yes.astype(float)
    )
    return table.assign(gap=table["p_contact"] - table["p_yes"]).reset_index(drop=True)


def anchor_scores(stimuli: pd.DataFrame, level: float = 0.95) -> pd.DataFrame:
    """Return `with_kind` of the scores of the computed anchors; empty without people.

    ``stimuli``: as for `anchor_stimuli`.
    """
    seen, answers = seen_stimuli(stimuli), anchor_stimuli(stimuli)
    if seen.empty:
        return pd.DataFrame()
    parts = [score_table(answers, level)] if len(answers) else []
    parts.append(two_people_table(seen, level))
    return with_kind(pd.concat(parts, ignore_index=True))


def with_kind(scores: pd.DataFrame, names: str = "agent") -> pd.DataFrame:
    """Return a table with the column ``kind`` after that of the names of models."""
    table = scores.copy()
    kinds = [kind_of(str(name)) for name in scores[names]]
    table.insert(list(table.columns).index(names) + 1, "kind", kinds)
    return table


def add_anchors(models: Models, answers: ScenarioAnswers) -> Models:
    """Return the models with `OUTCOME` and `MAJORITY` as the last two, unless they were given."""
    rows = {OUTCOME: answers.label, MAJORITY: answers.p_yes() > 0.5}
    names = not_given(models.names)
    added = [rows[name].astype(np.float64)[None] for name in names]
    return Models(
        (*models.names, *names),
        np.vstack([models.p_contact, *added]),
        np.vstack([models.predicted, *added]),
    )
