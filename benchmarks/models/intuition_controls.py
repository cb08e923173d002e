"""Controls of `intuition.py`: features without something, answers fitted to people, the ceiling.

Features are (n, T, D) of `state-trees`, `mask-trees` and `blob-trees`, whose columns
`physion.models.baselines.trees` names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.optimize import minimize, nnls
from scipy.special import expit, logit, xlogy

from physion.models.baselines.trees import NEAREST, STATE_FEATURES

F64 = NDArray[np.float64]
Columns = Callable[[F64, bool], F64]
"""Features (n, T, D), and whether they are states, to the columns (n, C) that a forest sees."""

BLOB, SLOT = 10, 20
"""Columns of a mask, and of a body."""
_PLACE, _VECTORS, _SPEEDS = slice(2, 5), slice(5, 17), slice(11, 17)
"""Columns of a body: its centre, its axes and velocities, and its velocities only."""


# Features without something.


def every(values: F64, states: bool) -> F64:
    """Return all features."""
    return values.reshape(len(values), -1)


def last_frame(values: F64, states: bool) -> F64:
    """Return the features of the last observed frame."""
    return values[:, -1]


def first_places(values: F64, states: bool) -> F64:
    """Return where everything is in the first frame, without velocities and changes."""
    if not states:
        return values[:, 0, : values.shape[2] // 2]
    first = turned_to(values[:, :1], 0)[:, 0]
    names = np.array([name.split()[-1] for name in STATE_FEATURES])
    return first[:, ~np.isin(names, ("vx", "vy", "vz", "wx", "wy", "wz", "approach"))]


def shuffled(values: F64, states: bool) -> F64:
    """Return all features, each trial's frames in a random order; changes are of that order."""
    rng = np.random.default_rng(0)
    orders = np.argsort(rng.random(values.shape[:2]), axis=1)
    mixed = np.take_along_axis(values, orders[..., None], axis=1)
    return every(mixed if states else with_changes(mixed), states)


def exchanged(values: F64, states: bool) -> F64:
    """Return all features with agent and patient in each other's place."""
    if not states:
        half = values.shape[2] // 2
        mixed = values.copy()
        mixed[..., :BLOB] = values[..., BLOB : 2 * BLOB]
        mixed[..., BLOB : 2 * BLOB] = values[..., :BLOB]
        mixed[..., half - 4 : half - 2] *= -1
        return every(with_changes(mixed), states)
    mixed = values.copy()
    mixed[..., :SLOT], mixed[..., SLOT : 2 * SLOT] = (
        values[..., SLOT : 2 * SLOT],
        values[..., :SLOT],
    )
    mixed[..., STATE_FEATURES.index("up")] *= -1
    mixed = turned_to(mixed, -1)
    # Others stand in the order of their distance from the patient at the last frame.
    start, stop = 3 * SLOT, (3 + NEAREST) * SLOT
    others = mixed[..., start:stop].reshape(*mixed.shape[:2], NEAREST, SLOT)
    patient = mixed[:, -1, SLOT : 2 * SLOT][:, None, _PLACE]
    apart = np.linalg.norm(others[:, -1, :, _PLACE] - patient, axis=-1)
    order = np.where(others[:, -1, :, 0] > 0, apart, np.inf).argsort(axis=1, kind="stable")
    sorted_others = np.take_along_axis(others, order[:, None, :, None], axis=2)
    mixed[..., start:stop] = sorted_others.reshape(*mixed.shape[:2], -1)
    return every(mixed, states)


def with_changes(values: F64) -> F64:
    """Return features of masks with the changes since the frame before in the second half."""
    half = values.shape[2] // 2
    now = values[..., :half]
    return np.concatenate([now, np.diff(now, axis=1, prepend=now[:, :1])], axis=2)


def turned_to(values: F64, frame: int) -> F64:
    """Return features of states with the origin below the patient and the first axis to the agent.

    Both as they are in ``frame``.
    """
    slots = values.shape[2] // SLOT
    turned = values.copy()
    things = turned[..., : slots * SLOT].reshape(*values.shape[:2], slots, SLOT)
    agent, patient = (things[:, frame, place, _PLACE][:, :2] for place in (0, 1))
    ahead = agent - patient
    length = np.linalg.norm(ahead, axis=1, keepdims=True)
    ahead = np.where(length > 0, ahead / np.where(length > 0, length, 1), [1.0, 0.0])
    axes = np.stack([ahead, ahead[:, ::-1] * [-1, 1]], axis=1)
    there = things[..., :1] > 0
    origin = np.pad(patient, ((0, 0), (0, 1)))[:, None, None]
    things[..., _PLACE] -= origin * there
    for start in (2, 5, 8, 11, 14):
        flat = things[..., start : start + 2]
        things[..., start : start + 2] = np.einsum("nij,ntkj->ntki", axes, flat)
    turned[..., : slots * SLOT] = things.reshape(*values.shape[:2], -1)
    return turned


@dataclass(frozen=True)
class Control:
    """Columns on which forests are fitted, and with which they are tested."""

    name: str
    fit: Columns
    test: Columns


CONTROLS = (
    Control("last frame", last_frame, last_frame),
    Control("frames shuffled", shuffled, shuffled),
    Control("places in the first frame", first_places, first_places),
    Control("agent and patient exchanged in the test", every, exchanged),
)


# Answers brought to the spread of others, and fitted to people.


def with_spread(answers: pd.Series, other: pd.Series, scenario: pd.Series) -> pd.Series:
    """Return answers that have the values of others, in their own order, within each scenario.

    Equal answers get the mean of their values.
    """
    out = answers.copy()
    for _, rows in answers.groupby(scenario):
        ranks = rows.rank(method="first").astype(int).to_numpy() - 1
        values = pd.Series(np.sort(other[rows.index].to_numpy())[ranks], rows.index)
        out[rows.index] = values.groupby(rows).transform("mean")
    return out


def halves(scenario: pd.Series, seed: int = 0) -> NDArray[np.bool_]:
    """Return which stimuli are in the first half of each scenario, by a random order."""
    order = pd.Series(np.random.default_rng(seed).random(len(scenario)), scenario.index)
    place = order.groupby(scenario).rank(method="first")
    return (place <= order.groupby(scenario).transform("size") / 2).to_numpy()


def likelihood(p: F64, yes: F64, count: F64) -> float:
    """Return the log-likelihood of ``yes`` of ``count`` answers, less what does not depend on p."""
    p = np.clip(p, 0.01, 0.99)
    return float((xlogy(yes, p) + xlogy(count - yes, 1 - p)).sum())


def best_level(levels: pd.DataFrame, people: pd.DataFrame, scenario: pd.Series) -> pd.Series:
    """Return the answers of the level of noise that is likeliest by people's answers.

    One level for each scenario, chosen on one half of the stimuli and used on the other.
    ``levels`` has a column for each level, ``people`` the columns ``yes`` and ``count``.
    """
    first, out = halves(scenario), pd.Series(np.nan, levels.index)
    for half in (first, ~first):
        for name in scenario.unique():
            inside = (scenario == name).to_numpy()
            fit, test = levels.index[inside & half], levels.index[inside & ~half]
            yes, count = (people.loc[fit, column].to_numpy(float) for column in ("yes", "count"))
            scores = [likelihood(levels.loc[fit, one].to_numpy(), yes, count) for one in levels]
            out[test] = levels.loc[test, levels.columns[int(np.argmax(scores))]]
    return out


def weighted(answers: pd.DataFrame, people: pd.DataFrame, scenario: pd.Series) -> pd.Series:
    """Return a sum of answers, a constant and weights above 0, fitted on the other stimuli."""
    first, out = halves(scenario), pd.Series(np.nan, answers.index)
    design = np.column_stack([answers.to_numpy(), np.ones(len(answers))])
    fraction = (people["yes"] / people["count"])[answers.index].to_numpy()
    for half in (first, ~first):
        weights, _ = nnls(design[half], fraction[half])
        out[~half] = design[~half] @ weights
    return out.clip(0, 1)


def logistic_weights(answers: pd.DataFrame, yes: F64, count: F64) -> F64:
    """Return the weights of the log odds of answers, and a constant, by maximum likelihood.

    ``yes`` of ``count`` answers are to be explained: contacts, or people who say yes.
    """
    design = log_odds(answers)

    def loss(weights: F64) -> float:
        return -likelihood(expit(design @ weights), yes, count) / len(design)

    start = np.append(np.full(answers.shape[1], 1 / answers.shape[1]), 0.0)
    return np.asarray(minimize(loss, start, method="Nelder-Mead", options={"maxiter": 4000}).x)


def log_odds(answers: pd.DataFrame) -> F64:
    """Return the log odds of answers (n, m), and a column of ones."""
    return np.column_stack([logit(answers.clip(0.02, 0.98).to_numpy()), np.ones(len(answers))])


def fitted_to_people(
    answers: pd.DataFrame, people: pd.DataFrame, scenario: pd.Series
) -> tuple[pd.Series, F64]:
    """Return a mixture of answers, weighted as fits the other half of stimuli, and the weights.

    The weights (2, m + 1) are of both halves.
    """
    first, out, found = halves(scenario), pd.Series(np.nan, answers.index), []
    table = people.loc[answers.index]
    for half in (first, ~first):
        yes, count = (table[column].to_numpy(float)[half] for column in ("yes", "count"))
        found.append(logistic_weights(answers[half], yes, count))
        out[~half] = expit(log_odds(answers[~half]) @ found[-1])
    return out, np.array(found)


# What the best model could reach: halves of the people.


def partial(p: F64, other: F64, outcome: NDArray[np.bool_]) -> float:
    """Return the r of two answers (n,) beyond the outcome (n,)."""
    left = []
    for values in (p, other):
        means = np.where(outcome, values[outcome].mean(), values[~outcome].mean())
        left.append(values - means)
    return float(np.corrcoef(*left)[0, 1])


def ceiling(
    people: pd.DataFrame, outcome: NDArray[np.bool_], splits: int = 200
) -> tuple[float, float]:
    """Return the reliability of people's answers beyond the outcome, and the ceiling of a model.

    The people of every stimulus are divided at random into halves, whose r beyond the outcome is r;
    all together have the reliability R = 2 r / (1 + r), and a model that knows the true fractions
    has sqrt(R). Answers of one person to different stimuli count as independent.
    """
    rng = np.random.default_rng(0)
    yes, count = people["yes"].to_numpy(np.int64), people["count"].to_numpy(np.int64)
    found = []
    for _ in range(splits):
        some = rng.hypergeometric(yes, count - yes, count // 2)
        found.append(partial(some / (count // 2), (yes - some) / (count - count // 2), outcome))
    r = float(np.mean(found))
    reliability = 2 * r / (1 + r)
    return reliability, float(np.sqrt(reliability))


def slope(counts: Sequence[int], accuracies: Sequence[float]) -> float:
    """Return by how much accuracy rises with each doubling of the trials, by least squares."""
    return float(np.polyfit(np.log2(counts), accuracies, 1)[0])
