"""Power of a planned study: how often an effect of a given size is found, by simulation.

The fractions of yes of stimuli that people have answered are drawn with replacement as the stimuli
of the planned study. A person's log odds of yes at a stimulus are the log odds of its fraction plus
a leaning of the person. Two questions can be asked:

- *models*: do two models differ in r with the average person? The effect is the difference of
  their expected r with the true fractions of yes. Test: jackknife interval of the difference over
  stimuli, as in `statistics.paired`.
- *groups*: do two groups of people differ in accuracy? The effect is the difference of their
  expected accuracies. Test: Welch's t of the accuracies of persons.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt
import pandas as pd
from scipy import optimize, special, stats

from physion.analysis.intervals import jackknife, wilson
from physion.analysis.statistics.agreement import correlate_resampled
from physion.core.errors import BadInputError
from physion.core.seeds import generator

Array = npt.NDArray[np.float64]

Question = Literal["models", "groups"]
QUESTIONS: tuple[Question, ...] = get_args(Question)
COLUMNS = ("people", "stimuli", "effect", "repeats", "power", "low", "high")


@dataclass(frozen=True)
class PlannedEffect:
    """What is to be found.

    - ``question``: `QUESTIONS`; ``effect``: the size of the difference, above 0;
    - ``base``: expected r of the worse model (*models*); with *groups* the accuracy of the first
      group comes from the stimuli, and ``base`` is not used;
    - ``alike``: r of the two models given the fractions of yes (*models*): the more alike, the
      easier a difference is found;
    - ``person_sd``: standard deviation of persons in log odds: of leaning to yes (*models*) and of
      ability (*groups*).

    Raises `BadInputError` for values that no study can have.
    """

    question: Question = "models"
    effect: float = 0.1
    base: float = 0.5
    alike: float = 0.5
    person_sd: float = 0.35

    def __post_init__(self) -> None:
        if self.question not in QUESTIONS:
            raise BadInputError(f"question {self.question!r} is none of {', '.join(QUESTIONS)}")
        if not 0 < self.effect < 1 or self.person_sd < 0:
            raise BadInputError("an effect lies between 0 and 1, and a standard deviation above 0")
        if self.question == "models" and not -1 < self.base < self.base + self.effect < 1:
            raise BadInputError(f"r of {self.base:g} plus {self.effect:g} does not lie in -1..1")
        if not -1 < self.alike < 1:
            raise BadInputError("the models' r with each other must lie between -1 and 1")


def power_table(
    fractions: pd.DataFrame,
    planned: PlannedEffect,
    people: Sequence[int] = (20, 40, 60, 100),
    stimuli: Sequence[int] = (30, 60, 100, 150),
    *,
    level: float = 0.95,
    repeats: int = 400,
    seed: int = 0,
) -> pd.DataFrame:
    """Return the power of studies of several sizes.

    Parameters
    ----------
    fractions
        Stimuli that people answered: ``p_yes`` (fraction of yes), ``count`` (people), ``label``.
        Noise of few people spreads the fractions; they are drawn towards 1/2 by half an answer of
        either kind.
    planned
        The effect.
    people, stimuli
        Sizes; with *groups* ``people`` is the number in each group.
    level
        One less the probability of finding an effect that is not there.
    repeats, seed
        Number of simulated studies of each size, and the seed.

    Returns
    -------
    table
        `COLUMNS`: one row per size, with the fraction of studies that find the effect (a difference
        in the right direction whose interval excludes 0) and its 95 % interval (Wilson).
    """
    if min(*people, *stimuli) < 3 or repeats < 1 or not 0 < level < 1:
        raise BadInputError("a planned study needs 3 people and 3 stimuli, and one repeat or more")
    if fractions.empty:
        raise BadInputError("power needs the fractions of yes of stimuli that people answered")
    yes = (fractions["p_yes"] * fractions["count"] + 0.5) / (fractions["count"] + 1)
    logit = special.logit(yes.to_numpy(dtype=np.float64))
    find: Callable[..., bool] = _models_differ
    if planned.question == "groups":
        logit = np.where(fractions["label"].to_numpy(dtype=bool), logit, -logit)
        find = partial(_groups_differ, shift=_shift_of_groups(logit, planned))
    records = []
    for n, s in product(people, stimuli):
        rng = generator("power", seed, n, s)
        found = sum(find(rng.choice(logit, s), n, planned, level, rng) for _ in range(repeats))
        low, high = map(float, wilson(found / repeats, repeats))
        records.append((n, s, planned.effect, repeats, found / repeats, low, high))
    return pd.DataFrame(records, columns=list(COLUMNS))


def _models_differ(
    logit: Array,
    people: int,
    planned: PlannedEffect,
    level: float,
    rng: np.random.Generator,
) -> bool:
    """Simulate one study of two models, and return whether the better one is found.

    ``logit`` (s,): log odds of yes.

    Notes
    -----
    With the standardised true fractions q and standard normal e0, e1, e2, model k is::

        r_k q + sqrt(1 - r_k^2) (sqrt(a) e0 + sqrt(1 - a) e_k)

    for a of 0 or more, so that its r with q is r_k and the models' partial r given q is a; for a
    below 0 the second model has -e0.
    """
    true = special.expit(logit)
    if np.ptp(true) == 0:
        return False
    q = (true - true.mean()) / true.std()
    shared, own = rng.normal(size=len(q)), rng.normal(size=(2, len(q)))
    a = abs(planned.alike)
    sign = np.array([1.0, np.sign(planned.alike) or 1.0])[:, None]
    noise = np.sqrt(a) * sign * shared + np.sqrt(1 - a) * own
    r = np.array([planned.base + planned.effect, planned.base])[:, None]
    models = r * q + np.sqrt(1 - r**2) * noise
    lean = planned.person_sd * rng.normal(size=(people, 1))
    p_yes = (rng.random((people, len(q))) < special.expit(logit + lean)).mean(axis=0)
    weights = np.vstack([np.ones(len(q)), 1 - np.eye(len(q))])
    values = correlate_resampled(models, np.broadcast_to(p_yes, weights.shape), weights)
    difference = values[:, 0] - values[:, 1]
    low, _ = jackknife(difference[1:]).interval(float(difference[0]), level)
    return bool(low > 0)


def _shift_of_groups(logit: Array, planned: PlannedEffect) -> float:
    """Return by how much the log odds of being right differ, so that accuracies differ as planned.

    Raises `BadInputError` if the first group is too good for such an effect.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    persons = planned.person_sd * nodes

    def accuracy(shift: float) -> float:
        return float(
            special.expit(logit[:, None] + shift + persons).mean(axis=0) @ weights / weights.sum()
        )

    first = accuracy(0.0)
    if first - planned.effect <= accuracy(-20.0):
        raise BadInputError(
            f"people of these stimuli are right in {first:.2f} of answers: the other group cannot "
            f"be worse by {planned.effect:g}"
        )
    root = optimize.brentq(lambda shift: accuracy(shift) - first + planned.effect, -20.0, 0.0)
    return float(root)


def _groups_differ(
    logit: Array,
    people: int,
    planned: PlannedEffect,
    level: float,
    rng: np.random.Generator,
    *,
    shift: float,
) -> bool:
    """Simulate one study of two groups, and return whether the worse one is found.

    ``logit`` (s,): log odds of being right in the first group; ``shift``: of the second, less
    these.
    """
    accuracy = []
    for own_shift in (0.0, shift):
        ability = planned.person_sd * rng.normal(size=(people, 1))
        right = rng.random((people, len(logit))) < special.expit(logit + own_shift + ability)
        accuracy.append(right.mean(axis=1))
    if np.ptp(accuracy[0]) == 0 and np.ptp(accuracy[1]) == 0:
        return bool(accuracy[0][0] > accuracy[1][0])
    test = stats.ttest_ind(accuracy[0], accuracy[1], equal_var=False)
    return bool(test.pvalue < 1 - level and test.statistic > 0)
