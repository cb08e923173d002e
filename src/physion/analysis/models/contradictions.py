"""Inputs of a comparison that contradict each other: errors where sure, else warnings.

Outcomes that are the wrong way round, or a table that was cut, give plausible numbers. Every check
here compares two things that the tables say about the same stimuli.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np
import pandas as pd
from scipy import stats

from physion.analysis.tables.stimuli import in_order
from physion.core.errors import BadInputError
from physion.core.names import is_ledge, scenario_of

SURE = 1e-3
"""Probability under chance below which outcomes that mostly differ are called opposite."""

BELOW_CHANCE = -4.0
"""z of a model's accuracy, against independent answers, below which it is called opposite."""


def check_probabilities(predictions: pd.DataFrame) -> list[str]:
    """Return a warning for each model whose predicted outcomes contradict its probabilities.

    ``predictions``: from `predictions.read_predictions`. A P(contact) of 0.5 contradicts nothing.
    Raises `BadInputError` for a model that contradicts itself in so many rows that chance is
    excluded (binomial test against one half, p < `SURE`) and whose P(contact) is larger where it
    predicts no contact: then the probability is that of no contact. A model with another threshold
    than 0.5 is only warned of.
    """
    found = []
    for agent, rows in predictions.groupby("agent", sort=False):
        p = rows["p_contact"]
        against = (p != 0.5) & ((p > 0.5) != rows["predicted"])
        count = int(against.sum())
        if not count:
            continue
        first = rows[against].iloc[0]
        what = (
            f"{agent}: Predicted Outcome contradicts Predicted Prob_true in {count} of "
            f"{len(rows)} rows, the first is {first['stimulus']!r} ({first['predicted']}, "
            f"{first['p_contact']:g})"
        )
        opposite = p[rows["predicted"]].mean() < p[~rows["predicted"]].mean()
        if opposite and stats.binom.sf(count - 1, len(rows), 0.5) < SURE:
            raise BadInputError(
                f"{what}; Predicted Prob_true must be the probability of a contact, and True in "
                "Predicted Outcome must mean a contact"
            )
        found.append(
            f"{what}: accuracy and kappa are those of the outcome, r and RMSD of the probability"
        )
    return found


def check_outcomes(stimuli: pd.DataFrame) -> list[str]:
    """Return a warning for each scenario whose official outcomes are mostly not those shown.

    ``stimuli``: from `comparison.Comparison`. Raises `BadInputError` where so many differ that
    chance is excluded (binomial test against one half, p < `SURE`): then the labels are opposite.
    """
    found = []
    single = stimuli.drop_duplicates("stimulus")
    for scenario in in_order(single["scenario"]):
        rows = single[single["scenario"] == scenario]
        differ = int((rows["label"].astype(bool) != rows["simulated"].astype(bool)).sum())
        if 2 * differ <= len(rows):
            continue
        what = (
            f"{scenario}: the official outcome is not that of the trial shown to the models "
            f"(Actual Outcome) in {differ} of {len(rows)} stimuli"
        )
        if stats.binom.sf(differ - 1, len(rows), 0.5) < SURE:
            raise BadInputError(
                f"{what}: the outcomes of one of the two tables are opposite; True must mean a "
                "contact in the labels and in the predictions"
            )
        found.append(f"{what}, so models and people were asked about different events")
    return found


def check_accuracy(stimuli: pd.DataFrame) -> list[str]:
    """Return a warning for each model that is right far less often than by guessing.

    Its accuracy a is compared with that of independent answers with the same fraction of yes,
    e = p q + (1 - p)(1 - q) for fractions p of contacts and q of answers yes:
    z = (a - e) / sqrt(e (1 - e) / n) below `BELOW_CHANCE`.
    """
    found = []
    for agent, rows in stimuli.groupby("agent", sort=False):
        contact, yes = rows["label"].mean(), rows["predicted"].mean()
        by_chance = contact * yes + (1 - contact) * (1 - yes)
        accuracy = float((rows["label"] == rows["predicted"]).mean())
        spread = np.sqrt(by_chance * (1 - by_chance) / len(rows))
        if spread > 0 and (accuracy - by_chance) / spread < BELOW_CHANCE:
            found.append(
                f"{agent} is right in {accuracy:.0%} of {len(rows)} stimuli, far less than by "
                "guessing: its answers, or the outcomes, may be opposite"
            )
    return found


def check_labels_of_people(people: pd.DataFrame, predicted: Collection[str]) -> list[str]:
    """Return a warning for each scenario with answered and predicted stimuli without an outcome.

    ``people``: answers by stimulus, with ``scenario`` and ``label``; ``predicted``: stimuli that a
    model predicts.
    """
    found = []
    both = people[people["stimulus"].isin(set(predicted)) & people["scenario"].notna()]
    for scenario in in_order(both["scenario"]):
        rows = both[both["scenario"] == scenario]
        missing = rows.loc[rows["label"].isna(), "stimulus"]
        if len(missing):
            found.append(
                f"{scenario}: {len(missing)} of {len(rows)} stimuli that people and models "
                f"answered have no official outcome, the first is {missing.iloc[0]!r}: is the "
                "table of labels cut?"
            )
    return found


def check_coverage(people: pd.DataFrame, labels: Mapping[str, bool]) -> list[str]:
    """Return a warning for each scenario whose table of people lacks stimuli with a label.

    ``people``: answers by stimulus of scenarios that were asked; ``labels``: official outcome of
    every stimulus that people saw, by canonical name. Roll's ledges may be absent.
    """
    found = []
    answered = set(people["stimulus"])
    shown = [name for name in labels if not is_ledge(name)]
    for scenario in in_order(people["scenario"]):
        names = [name for name in shown if scenario_of(name) == scenario]
        missing = [name for name in names if name not in answered]
        if missing:
            found.append(
                f"{scenario}: {len(missing)} of {len(names)} stimuli with an official outcome have "
                f"no answer of people, the first is {missing[0]!r}: is the table of people cut?"
            )
    return found
