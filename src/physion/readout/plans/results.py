"""Table of the results of a plan: accuracy by model, protocol, readout and scenario."""

from __future__ import annotations

from collections.abc import Iterable

import pandas as pd

from physion.readout.plans.tasks import EvaluationTask
from physion.readout.table import Evaluation

MEAN = "mean"
"""Name of the rows with the mean of the scenarios."""
_MODEL = ["model", "init", "protocol", "readout"]
_GROUP = [*_MODEL, "scenario"]


def summarise_accuracy(evaluated: Iterable[tuple[EvaluationTask, Evaluation]]) -> pd.DataFrame:
    """Return the accuracy of evaluations, as mean and spread over seeds.

    Parameters
    ----------
    evaluated
        Tasks and their evaluations; no prediction may occur twice.

    Returns
    -------
    pandas.DataFrame
        Columns ``model``, ``init`` (its initial weights), ``protocol`` (of training; empty without
        one), ``readout``, ``scenario``, ``seeds`` and ``trials`` (numbers of them), ``accuracy``
        (0..1, mean of the seeds), ``spread`` (standard deviation of a seed, n - 1; NaN for one
        seed). Rows with the scenario `MEAN` are of the mean of the scenarios of each seed, where
        there are several.
    """
    rows = []
    for task, evaluation in evaluated:
        table = evaluation.predictions
        hits = table["Predicted Outcome"] == table["Actual Outcome"]
        named = pd.DataFrame(
            {
                "model": table["Model"],
                "init": table["Init"],
                "protocol": task.protocol.value if task.set_name else "",
                "readout": table["Protocol"],
                "scenario": table["Readout Test Data"],
                "seed": task.seed,
                "hit": hits.astype(float),
            }
        )
        rows.append(named)
    if not rows:
        return pd.DataFrame(columns=[*_GROUP, "seeds", "trials", "accuracy", "spread"])
    trials = pd.concat(rows, ignore_index=True)
    by_seed = trials.groupby([*_GROUP, "seed"])["hit"].agg(accuracy="mean", trials="size")
    by_seed = by_seed.reset_index()
    whole = by_seed.groupby([*_MODEL, "seed"]).agg(
        accuracy=("accuracy", "mean"), trials=("trials", "sum"), scenarios=("scenario", "size")
    )
    whole = whole[whole["scenarios"] > 1].reset_index().assign(scenario=MEAN)
    every = pd.concat([by_seed, whole.drop(columns="scenarios")], ignore_index=True)
    # So that the mean stands below the scenarios.
    every["last"] = every["scenario"] == MEAN
    summary = every.groupby([*_MODEL, "last", "scenario"]).agg(
        seeds=("seed", "nunique"),
        trials=("trials", "max"),
        accuracy=("accuracy", "mean"),
        spread=("accuracy", "std"),
    )
    return summary.reset_index().drop(columns="last")
