"""Results of a plan: evaluations as they are recorded, and the table of their accuracies."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from physion.readout.plans.tasks import EvaluationTask
from physion.readout.tables import Evaluation, read_table

MEAN = "mean"
"""Name of the rows with the mean of the scenarios."""
_MODEL = ["model", "init", "protocol", "readout"]
_GROUP = [*_MODEL, "scenario"]
_COLUMNS = {
    "model": "Model",
    "init": "Init",
    "readout": "Protocol",
    "scenario": "Readout Test Data",
}
"""Columns of a table of predictions that name a score, by their names there."""


@dataclass(frozen=True)
class StoredEvaluation:
    """Evaluation of a plan, of which the table is read only if it is asked for.

    - ``path``, ``problems``, ``rollout_errors``: as in `physion.readout.tables.Evaluation`.
    - ``count``: number of predictions.
    - ``scores``: rows of JSON values: ``model``, ``init``, ``readout``, ``scenario``, ``hits`` and
      ``trials`` (numbers of right predictions, and of all).
    """

    path: Path
    problems: Mapping[str, str]
    rollout_errors: Path | None
    count: int
    scores: Sequence[Mapping[str, Any]]

    @classmethod
    def of(cls, evaluation: Evaluation) -> StoredEvaluation:
        """Return an evaluation with the scores of its table."""
        table = evaluation.predictions
        hits = table["Predicted Outcome"] == table["Actual Outcome"]
        scores = [
            {
                **dict(zip(_COLUMNS, key, strict=True)),
                "hits": int(of_cell.sum()),
                "trials": len(of_cell),
            }
            for key, of_cell in hits.groupby([table[name] for name in _COLUMNS.values()])
        ]
        return cls(
            evaluation.path, evaluation.problems, evaluation.rollout_errors, len(table), scores
        )

    @cached_property
    def predictions(self) -> pd.DataFrame:
        """Table of predictions."""
        return read_table(self.path)


def summarise_accuracy(
    evaluated: Iterable[tuple[EvaluationTask, StoredEvaluation]],
) -> pd.DataFrame:
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
    rows = [
        {"protocol": task.protocol.value if task.set_name else "", "seed": task.seed, **score}
        for task, evaluation in evaluated
        for score in evaluation.scores
    ]
    if not rows:
        return pd.DataFrame(columns=[*_GROUP, "seeds", "trials", "accuracy", "spread"])
    by_seed = pd.DataFrame(rows).groupby([*_GROUP, "seed"])[["hits", "trials"]].sum().reset_index()
    by_seed["accuracy"] = by_seed.pop("hits") / by_seed["trials"]
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
