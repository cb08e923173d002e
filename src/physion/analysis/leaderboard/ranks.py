"""How certain the ranks of a leaderboard are: bootstrap over people and stimuli."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt
import pandas as pd

from physion.analysis.metrics import Metric
from physion.analysis.models.model_people import Models, sample_of_models
from physion.analysis.people.answers import ScenarioAnswers
from physion.analysis.people.people import draws_of_people
from physion.analysis.sample import Sample, pool
from physion.analysis.statistics.agreement import pair_difference
from physion.analysis.statistics.bootstrap import Bootstrap
from physion.analysis.tables.stimuli import MEAN, POOLED, in_order

Array = npt.NDArray[np.float64]
KEY = ["file", "agent"]
COLUMNS = ("rank_low", "rank_high", "first")


def rank_intervals(
    stimuli: pd.DataFrame,
    answers: Mapping[str, ScenarioAnswers],
    metric: Metric,
    scenario: str,
    bootstrap: Bootstrap,
) -> pd.DataFrame:
    """Return how the ranks of models vary with other people and stimuli.

    Parameters
    ----------
    stimuli
        Rows of `Comparison.stimuli` with ``file``: the models that are ranked, all of which predict
        the same stimuli.
    answers
        Answers of single participants by scenario; of scenarios without them the averages of people
        stay as they are.
    metric
        What models are ranked by.
    scenario
        One scenario, *mean* or *pooled*.
    bootstrap
        Draws of people and of stimuli, within scenarios.

    Returns
    -------
    table
        One row a model: ``file``, ``agent``, ``rank_low``, ``rank_high`` (2.5th and 97.5th
        percentile of its rank) and ``first`` (fraction of draws in which no model is better). Empty
        if the metric needs single answers that are not known.

    Notes
    -----
    All models get the same draws. Drawn people add the noise of their averages a second time
    (`jackknife`), which raises the RMSD of all models alike and does not favour any.
    """
    names = [tuple(pair) for pair in stimuli[KEY].drop_duplicates().itertuples(index=False)]
    nothing = pd.DataFrame(columns=[*KEY, *COLUMNS])
    chosen = in_order(stimuli["scenario"]) if scenario in (MEAN, POOLED) else [scenario]
    single = all(name in answers for name in chosen)
    if not names or (metric.needs == "participants" and (not single or scenario == POOLED)):
        return nothing
    samples = [
        _sample(stimuli[stimuli["scenario"] == name], names, answers.get(name), name, bootstrap)
        for name in chosen
    ]
    if scenario == POOLED:
        values = metric(pool(samples))
    else:
        values = np.mean([metric(sample) for sample in samples], axis=0)
    ranks = _ranks(values, metric)
    tail = 50 * (1 - bootstrap.level)
    low, high = np.percentile(ranks, [tail, 100 - tail], axis=0, method="nearest")
    return pd.DataFrame(names, columns=KEY).assign(
        rank_low=low.astype(int), rank_high=high.astype(int), first=np.mean(ranks == 1, axis=0)
    )


def _sample(
    rows: pd.DataFrame,
    names: Sequence[tuple[str, str]],
    answers: ScenarioAnswers | None,
    scenario: str,
    bootstrap: Bootstrap,
) -> Sample:
    """Return the models and people of one scenario with the weights of the draws."""
    people = rows.drop_duplicates("stimulus").set_index("stimulus").sort_index()
    order = list(people.index) if answers is None else list(answers.stimuli)
    models = Models(
        tuple(f"{file} {agent}" for file, agent in names),
        _by_model(rows, "p_contact", names, order),
        _by_model(rows, "predicted", names, order),
    )
    weights = bootstrap.weights(scenario, len(order))
    if answers is not None:
        return sample_of_models(
            models, answers, weights, draws_of_people(answers, bootstrap), "both"
        )
    p_yes, accuracy, count = (
        people[name].to_numpy(dtype=np.float64) for name in ("p_yes", "human_accuracy", "count")
    )
    label = people["label"].to_numpy(dtype=np.float64)
    return Sample(
        p_contact=models.p_contact,
        predicted=models.predicted,
        label=label,
        shown=label,
        p_yes=p_yes[None],
        human_accuracy=accuracy[None],
        differ=pair_difference(p_yes, count)[None],
        stimuli=weights,
    )


def _by_model(
    rows: pd.DataFrame, column: str, names: Sequence[tuple[str, str]], stimuli: Sequence[str]
) -> Array:
    wide = rows.pivot(index=KEY, columns="stimulus", values=column)
    complete = wide.reindex(index=list(names), columns=list(stimuli))
    return np.asarray(complete, dtype=np.float64)


def _ranks(values: Array, metric: Metric) -> npt.NDArray[np.int_]:
    """Return 1 + the number of better models, (b, m); undefined values are the worst."""
    good = np.where(np.isfinite(values), values if metric.better == "higher" else -values, -np.inf)
    # Equal scores may differ in their last digits by the order of the sums.
    good = np.round(good, 12)
    return np.asarray(1 + np.sum(good[:, None, :] > good[:, :, None], axis=2))
