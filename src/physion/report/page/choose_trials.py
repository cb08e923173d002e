"""Choice of the stimuli that a page shows as movies; it depends on the tables alone."""

from __future__ import annotations

from collections.abc import Container

import numpy as np
import pandas as pd

from physion.analysis.models.comparison import Comparison
from physion.analysis.tables.stimuli import in_order

ACCURACY_STEP = 0.05
"""Stimuli whose accuracies of people lie in one such step count as equally clear to people."""

OPENING_RULE = (
    "Of each scenario the stimulus that most people judged rightly is shown (accuracies within the "
    "same 5 % count as equal) and, of these, the one that the models missed most; scenarios with "
    "and without contact alternate where people allow it. So these trials are clear to people, and "
    "no sample of all."
)
OPENING_RULE_ALONE = (
    "Of each scenario the stimulus that the models missed most is shown; scenarios with and "
    "without contact alternate."
)


WIDE = 0.5
"""Smallest |P(contact) - P(yes)| that counts as a disagreement."""


def opening_trials(comparison: Comparison, movies: Container[str] = ()) -> list[str]:
    """Return one stimulus of each scenario, in the order of the scenarios.

    In turn, the best by: a movie in ``movies``; a simulated outcome that is the official one;
    the number of models that answered; a majority of people that was right; contact in the first,
    third, ... scenario and none in the others; people's accuracy in steps of `ACCURACY_STEP`; the
    mean distance of the models' P(contact) from the outcome; the first name. Without people their
    part is left out.
    """
    found = []
    for position, scenario in enumerate(in_order(comparison.stimuli["scenario"])):
        rows = comparison.stimuli[comparison.stimuli["scenario"] == scenario]
        found.append(_best(rows, movies, contact=position % 2 == 0))
    return found


def _best(rows: pd.DataFrame, movies: Container[str], contact: bool) -> str:
    rows = rows.assign(miss=(rows["p_contact"] - rows["label"].astype(float)).abs())
    table = rows.groupby("stimulus", as_index=False).agg(
        models=("agent", "size"),
        label=("label", "first"),
        simulated=("simulated", "first"),
        accuracy=("human_accuracy", "first"),
        miss=("miss", "mean"),
    )
    accuracy = table["accuracy"].astype(float)
    # A little is added so that 0.95 is not counted below 19 steps of 0.05.
    steps = np.floor(accuracy / ACCURACY_STEP + 1e-9)
    table = table.assign(
        movie=[name in movies for name in table["stimulus"]],
        same=table["label"] == table["simulated"],
        right=accuracy > 0.5,
        turn=table["label"].astype(bool) == contact,
        step=steps.fillna(0.0),
    )
    order = ["movie", "same", "models", "right", "turn", "step", "miss", "stimulus"]
    best = table.sort_values(order, ascending=[False] * 7 + [True], kind="stable")
    return str(best["stimulus"].iloc[0])


def opinions(comparison: Comparison) -> pd.DataFrame:
    """Return the rows of ``comparison.stimuli`` of models that predict something themselves.

    Left out are models that were shown the outcome (readout *full*) and those that give all
    stimuli of every scenario the same P(contact); if none is left, all rows are returned.
    """
    rows = comparison.stimuli
    values = rows.groupby(["agent", "scenario"])["p_contact"].nunique()
    varied = values[values > 1].reset_index()["agent"].unique()
    kept = rows[rows["agent"].isin(varied) & (rows["readout"] != "full")]
    return rows if kept.empty else kept


def widest_gaps(comparison: Comparison, count: int) -> pd.DataFrame:
    """Return the stimuli on which a model and people differ most, at most ``count`` rows.

    Models alternate, each with all of its readouts (see `opinions` for models without a turn): each
    adds the stimulus with its largest |P(contact) - P(yes)|, at least `WIDE`, that is not yet
    chosen; ties are resolved by name. Stimuli whose simulated outcome is not the official one are
    skipped, since there the physics differs and not the model. The result has rows of
    ``comparison.stimuli`` with the column ``size``, each of the model that added it.
    """
    rows = opinions(comparison)
    rows = rows[(rows["label"] == rows["simulated"]) & (rows["gap"].abs() >= WIDE)]
    rows = rows.assign(size=rows["gap"].abs())
    ranked = rows.sort_values(["size", "stimulus"], ascending=[False, True], kind="stable")
    names = list(dict.fromkeys(rows["model"]))
    queues = [list(ranked.index[ranked["model"] == name]) for name in names]
    chosen: list[int] = []
    seen: set[str] = set()
    while len(chosen) < count and any(queues):
        for queue in queues:
            while queue and rows.loc[queue[0], "stimulus"] in seen:
                queue.pop(0)
            if queue and len(chosen) < count:
                chosen.append(queue.pop(0))
                seen.add(str(rows.loc[chosen[-1], "stimulus"]))
    return rows.loc[chosen]


def who_was_right(comparison: Comparison) -> pd.DataFrame:
    """Return how often the majority of people and each model were right on the same stimuli.

    A row a model (``agent``) with counts: ``stimuli``, ``both``, ``people``, ``model``, ``neither``
    right, ``divided``: exactly half of the people were right. The outcome is the official one.
    """
    rows = comparison.stimuli
    people, divided = rows["human_accuracy"] > 0.5, rows["human_accuracy"] == 0.5
    model = rows["predicted"].astype(bool) == rows["label"].astype(bool)
    counted = rows.assign(
        both=people & model,
        people=people & ~model,
        model_alone=~people & ~divided & model,
        neither=~people & ~divided & ~model,
        divided=divided,
    )
    keys = ["both", "people", "model_alone", "neither", "divided"]
    sums = counted.groupby("agent", sort=False)[keys].sum().astype(int)
    sums.insert(0, "stimuli", counted.groupby("agent", sort=False).size())
    return sums.reset_index().rename(columns={"model_alone": "model"})
