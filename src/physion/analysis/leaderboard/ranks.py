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
        One row a model: ``file``, ``agent``, ``rank_low`` and ``rank_high`` (the interval that
        contains its true rank with at least the level of ``bootstrap``) and ``first`` (fraction of
        draws in which no model is better). Empty if the metric needs single answers that are not
        known.

    Notes
    -----
    The ends of the interval of model j are 1 + the number of models that are significantly better,
    and 1 + the number of those that are not significantly worse (Mogstad et al., 2024, two-sided).
    With d_jk the difference of the scores of j and k and s_jk its standard deviation over draws, it
    is significant if abs(d_jk) > c_j s_jk. c_j is the quantile over draws of the largest deviation,
    max_k abs(d*_jk - mean d*_jk) / s_jk, so that all comparisons of j hold together. Models that
    are equal in all draws share the rank. Percentiles of the ranks of draws would be too narrow
    among models that differ little: draws scatter the models a second time, so that the first and
    the last of them move to the middle.

    All models get the same draws. Drawn people add the noise of their averages a second time
    (`jackknife`), which raises the RMSD of all models alike and does not favour any.

    References
    ----------
    Mogstad, M., Romano, J. P., Shaikh, A. M., & Wilhelm, D. (2024). Inference for ranks with
    applications to mobility across neighbourhoods and academic achievement across countries. Review
    of Economic Studies, 91(1), 476-518.
    """
    names = [tuple(pair) for pair in stimuli[KEY].drop_duplicates().itertuples(index=False)]
    nothing = pd.DataFrame(columns=[*KEY, *COLUMNS])
    chosen = in_order(stimuli["scenario"]) if scenario in (MEAN, POOLED) else [scenario]
    single = all(name in answers for name in chosen)
    if not names or (metric.needs == "participants" and (not single or scenario == POOLED)):
        return nothing

    def scores(draws: Bootstrap | None) -> Array:
        """Return the scores (b, m), higher for better models; without draws b is 1."""
        samples = [
            _sample(stimuli[stimuli["scenario"] == name], names, answers.get(name), name, draws)
            for name in chosen
        ]
        if scenario == POOLED:
            values = metric(pool(samples))
        else:
            values = np.mean([metric(sample) for sample in samples], axis=0)
        # Equal scores may differ in their last digits by the order of the sums.
        return np.round(values if metric.better == "higher" else -values, 12)

    drawn = scores(bootstrap)
    low, high = _bounds(scores(None)[0], drawn, bootstrap.level)
    return pd.DataFrame(names, columns=KEY).assign(
        rank_low=low, rank_high=high, first=np.mean(_ranks(drawn) == 1, axis=0)
    )


def _sample(
    rows: pd.DataFrame,
    names: Sequence[tuple[str, str]],
    answers: ScenarioAnswers | None,
    scenario: str,
    bootstrap: Bootstrap | None,
) -> Sample:
    """Return the models and people of one scenario, with the weights of draws if there are any."""
    people = rows.drop_duplicates("stimulus").set_index("stimulus").sort_index()
    order = list(people.index) if answers is None else list(answers.stimuli)
    models = Models(
        tuple(f"{file} {agent}" for file, agent in names),
        _by_model(rows, "p_contact", names, order),
        _by_model(rows, "predicted", names, order),
    )
    if answers is not None and bootstrap is None:
        return sample_of_models(models, answers)
    weights = np.ones((1, len(order)))
    if bootstrap is not None:
        weights = bootstrap.weights(scenario, len(order))
        if answers is not None:
            drawn = draws_of_people(answers, bootstrap)
            return sample_of_models(models, answers, weights, drawn, "both")
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


def _bounds(
    scores: Array, drawn: Array, level: float
) -> tuple[npt.NDArray[np.int_], npt.NDArray[np.int_]]:
    """Return the lowest and the highest rank (m,) of each model.

    Parameters
    ----------
    scores
        Scores (m,), higher for better models. Undefined ones (NaN) are the worst.
    drawn
        The same of each draw (b, m).
    level
        Least probability with which the interval of a model contains its true rank.
    """
    known, models = np.isfinite(scores), len(scores)
    others = known & ~np.eye(models, dtype=bool)
    low, high = np.ones(models, dtype=int), np.ones(models, dtype=int)
    for j in range(models):
        if not known[j]:
            low[j], high[j] = 1 + known.sum(), 1 + known.sum()
            continue
        better, deviation = scores - scores[j], drawn - drawn[:, [j]]
        defined = np.isfinite(deviation)
        # A model that is compared in few draws may be better or worse.
        comparable = known & (2 * defined.sum(axis=0) >= max(len(drawn), 3))
        deviation = np.where(defined, deviation, 0)[:, comparable]
        weights = defined[:, comparable].astype(np.float64)
        mean = np.average(deviation, axis=0, weights=weights)
        deviation = np.where(weights > 0, deviation - mean, 0)
        spread = np.sqrt(np.average(deviation**2, axis=0, weights=weights))
        varies = spread > 0
        relative = np.abs(deviation[:, varies]) / spread[varies]
        critical = np.quantile(relative.max(axis=1), level) if varies.any() else 0.0
        margin = np.full(models, np.inf)
        margin[comparable] = critical * spread
        equal = comparable & (margin == 0) & (better == 0)
        low[j] += np.sum(others[j] & (better > margin))
        high[j] += np.sum(others[j] & ~equal & (better >= -margin))
    return low, high


def _ranks(good: Array) -> npt.NDArray[np.int_]:
    """Return 1 + the number of better models, (b, m); undefined values are the worst."""
    good = np.where(np.isfinite(good), good, -np.inf)
    return np.asarray(1 + np.sum(good[:, None, :] > good[:, :, None], axis=2))
