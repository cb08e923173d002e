"""Models as a population next to people: consensus, disagreement, kappa of members and majorities.

A population has members who answer yes or no: the seeds or checkpoints of a model, or people. Two
raters are compared by the probabilities a and b with which they say yes to a stimulus, and c with
which both do. With means over stimuli::

    disagreement = mean(a + b - 2 c)
    kappa = 2 (mean(c) - mean(a) mean(b)) / (mean(a) (1 - mean(b)) + mean(b) (1 - mean(a)))

The raters are, for the fraction p of n members who say yes, or q of another population's:

- two *members*. Of models: every two different members, or every member of one population with
  every one of the other, whose answers are a and b, 1 or 0, and c = a b; kappa is the mean over
  these pairs, without those whose two members always give one and the same answer. Of people only
  p is known: a person is drawn anew for each stimulus, with a = p; of a person and a member with
  the answer b, c = p b; of two people a = b = p, c = p - p (1 - p) n / (n - 1);
- two *majorities*: m is 1 where p > 1/2, 0 where p < 1/2, and 1/2 where members are divided
  equally, as if a fair coin decided. Of two populations: a = m(p), b = m(q), c = m(p) m(q). Of one
  population with itself: of two random halves. Of k = n p answers yes, x are in the half of
  h = n // 2 members with the hypergeometric probability C(k, x) C(n - k, h - x) / C(n, h)::

    a = E m(x / h),   b = E m((k - x) / (n - h)),   c = E m(x / h) m((k - x) / (n - h))

Members disagree more than majorities do, so that both kappas are needed, each by its name.
Intervals are about other stimuli, by the jackknife (`intervals`); the members are the same.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy import stats

from physion.analysis.comparison import Comparison
from physion.analysis.intervals import Array, Scale, delete_one, jackknife
from physion.analysis.statistics.agreement import kappa_from_fractions, pair_difference
from physion.analysis.tables import DETECTION, MEAN, in_order, population_names
from physion.core.errors import BadInputError

PEOPLE = "people"
"""Name of the population of people."""
MODELS = "models"
"""Name of the population of all models, if each of them has one member only."""
WHOSE = ("members", "majorities")
"""Raters that are compared."""


@dataclass(frozen=True)
class PopulationResults:
    """Populations of models, and people, in the scenarios and in their `MEAN`.

    Numbers have their interval in columns ``_low`` and ``_high``.

    - ``consensus``: one row per population and scenario: ``population``, ``scenario``, ``members``
      (of people: median number who answered a stimulus), ``stimuli``, ``ties`` (stimuli on which
      the members are divided equally), ``consensus`` (accuracy of the majority; a tie is half
      right), ``member`` (mean accuracy of a member), ``member_sd`` (standard deviation over
      members, of models only).
    - ``agreement``: one row per two populations, or population with itself, and scenario:
      ``first``, ``second``, ``scenario``, ``stimuli``, ``disagreement_members``,
      ``kappa_members``, ``disagreement_majorities``, ``kappa_majorities``; ``reason`` of what is
      undefined. Of one population: two different members, and the majorities of random halves.
    - ``differences``: accuracy of each population less people's: ``population``, ``scenario``,
      ``stimuli``, ``consensus``, ``member``, by scenario from the largest difference of the
      consensus to the smallest, then `MEAN`. Empty without people.
    - ``warnings``: how many stimuli are left out, as a sentence, if any.
    """

    consensus: pd.DataFrame
    agreement: pd.DataFrame
    differences: pd.DataFrame
    warnings: tuple[str, ...] = ()


class _Raters(NamedTuple):
    """Probabilities with which two raters say yes to each stimulus, and both do.

    They are (s, pairs): one column for each pair of raters.
    """

    first: Array
    second: Array
    both: Array


@dataclass(frozen=True)
class _Population:
    """Answers of a population to the stimuli of each scenario, arrays (s,).

    ``yes``: fraction of the members who say yes; ``count``: members; ``label``: outcome 1 or 0.
    ``by_member``: accuracy of each member, by scenario (k,); empty where it is not known.
    ``answers``: 1 or 0 of each member, (s, members); of people, whose answers are not known, P(yes)
    as the only one.
    """

    name: str
    yes: Sequence[Array]
    count: Sequence[Array]
    label: Sequence[Array]
    by_member: Sequence[Array]
    answers: Sequence[Array]

    def majority(self, at: int) -> Array:
        """Return the answers of the majority, 1 or 0, or 1/2 for a tie."""
        return _majority(self.yes[at])

    def right(self, at: int) -> Array:
        """Return how right the majority is for each stimulus."""
        return 1 - np.abs(self.majority(at) - self.label[at])

    def member_right(self, at: int) -> Array:
        """Return the fraction of members who are right, for each stimulus."""
        return 1 - np.abs(self.yes[at] - self.label[at])

    def pair(self, at: int) -> _Raters:
        """Return every two different members; NaN for one member."""
        if self.by_member and self.answers[at].shape[1] > 1:
            one, other = np.triu_indices(self.answers[at].shape[1], 1)
            first, second = self.answers[at][:, one], self.answers[at][:, other]
            return _Raters(first, second, first * second)
        yes = self.yes[at]
        both = yes - pair_difference(yes, self.count[at]) / 2
        return _Raters(*(of[:, None] for of in (yes, yes, both)))

    def halves(self, at: int) -> _Raters:
        """Return the majorities of two random halves; NaN for one member."""
        count = np.rint(self.count[at]).astype(np.int64)
        yes = np.rint(self.yes[at] * count).astype(np.int64)
        half = count // 2
        drawn = np.arange(half.max(initial=0) + 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            p = stats.hypergeom.pmf(drawn, count[:, None], yes[:, None], half[:, None])
            # What is impossible has p = 0, and any answer.
            first = _majority(drawn / half[:, None])
            second = _majority((yes[:, None] - drawn) / (count - half)[:, None])
        sums = [
            np.sum(np.where(p > 0, p * x, 0.0), axis=1) for x in (first, second, first * second)
        ]
        return _Raters(*(np.where(count > 1, x, np.nan)[:, None] for x in sums))


def _majority(yes: Array) -> Array:
    """Return 1 where more than half say yes, 1/2 where exactly half do, else 0."""
    return np.where(yes > 0.5, 1.0, np.where(yes == 0.5, 0.5, 0.0))


def compare_populations(comparison: Comparison, predictions: pd.DataFrame) -> PopulationResults:
    """Compare models as populations with each other and with people.

    Parameters
    ----------
    comparison
        From `compare_scores`. Rows of the readout `DETECTION` and baselines are left out.
    predictions
        From `name_models`: models that differ in nothing but their seed, or file of weights, are
        one population. If no two do, all models together are the population `MODELS`.

    Raises
    ------
    BadInputError
        If there is one model of one seed only, or no stimulus that all members predict.
    """
    rows = comparison.stimuli
    rows = rows[rows["model"].isin(comparison.models) & (rows["readout"] != DETECTION)]
    rows = rows.assign(population=rows["model"].map(population_names(predictions)))
    if rows.groupby("population")["model"].nunique().max() == 1:
        rows = rows.assign(population=MODELS)
    if rows["model"].nunique() < 2:
        raise BadInputError(
            "a population needs several models: give predictions of several seeds or checkpoints "
            "of one model (--population)"
        )
    every = rows.pivot(index="stimulus", columns="model", values="predicted")
    wide = every.dropna().sort_index()
    if wide.empty:
        raise BadInputError("no stimulus is predicted by all members of the populations")
    warning = (
        f"populations: {len(every) - len(wide)} of {len(every)} stimuli are left out, since not "
        "all members predict them"
    )
    about = rows.drop_duplicates("stimulus").set_index("stimulus").loc[wide.index]
    scenarios = in_order(about["scenario"])
    parts = [(about["scenario"] == name).to_numpy() for name in scenarios]
    labels = [about["label"].to_numpy(np.float64)[part] for part in parts]
    populations = []
    for name, members in rows.groupby("population", sort=False)["model"].unique().items():
        answers = wide[list(members)].to_numpy(np.float64)
        yes = [answers[part].mean(axis=1) for part in parts]
        right = [(answers[part] == label[:, None]).mean(axis=0)
                 for part, label in zip(parts, labels, strict=True)]  # fmt: skip
        count = [np.full(len(label), float(len(members))) for label in labels]
        each = [answers[part] for part in parts]
        populations.append(_Population(str(name), yes, count, labels, right, each))
    populations.sort(key=lambda one: -np.mean([one.right(k).mean() for k in range(len(parts))]))
    if comparison.has_people:
        yes, count = (
            [about[column].to_numpy(np.float64)[part] for part in parts]
            for column in ("p_yes", "count")
        )
        fractions = [of[:, None] for of in yes]
        populations.insert(0, _Population(PEOPLE, yes, count, labels, (), fractions))
    return PopulationResults(
        pd.concat([_consensus(one, scenarios) for one in populations], ignore_index=True),
        _agreement(populations, scenarios),
        _differences(populations, scenarios),
        (warning,) if len(wide) < len(every) else (),
    )


def _consensus(population: _Population, scenarios: Sequence[str]) -> pd.DataFrame:
    sizes = [len(label) for label in population.label]
    spread = [by.std(ddof=1) if len(by) > 1 else np.nan for by in population.by_member]
    if population.by_member:
        means = np.mean(population.by_member, axis=0)
        spread.append(means.std(ddof=1) if len(means) > 1 else np.nan)
    members = [float(np.median(count)) for count in population.count]
    ties = [int((population.majority(at) == 0.5).sum()) for at in range(len(sizes))]
    table = pd.DataFrame(
        {
            "population": population.name,
            "scenario": [*scenarios, MEAN],
            "members": [*members, float(np.mean(members))],
            "stimuli": [*sizes, sum(sizes)],
            "ties": [*ties, sum(ties)],
        }
    )
    columns = {
        "consensus": _by_scenario(_mean_of(population.right), sizes, "fraction", True),
        "member": _by_scenario(_mean_of(population.member_right), sizes, "fraction"),
    }
    table = pd.concat([table, _with_ends(columns)], axis=1)
    return table.assign(member_sd=spread if spread else np.nan)


def _agreement(populations: Sequence[_Population], scenarios: Sequence[str]) -> pd.DataFrame:
    """Return every two populations, and each with itself."""
    sizes = [len(label) for label in populations[0].label]
    tables = []
    for i, first in enumerate(populations):
        for second in populations[i:]:
            raters = _raters(first, second)
            columns = {}
            for whose in WHOSE:
                of = raters[whose]
                columns[f"disagreement_{whose}"] = _by_scenario(
                    _disagreement_of(of), sizes, "fraction"
                )
                columns[f"kappa_{whose}"] = _by_scenario(_kappa_of(of), sizes, "correlation")
            table = pd.DataFrame({"first": first.name, "second": second.name,
                                  "scenario": [*scenarios, MEAN],
                                  "stimuli": [*sizes, sum(sizes)]})  # fmt: skip
            table = pd.concat([table, _with_ends(columns)], axis=1)
            one = first is second and np.max(first.count[0]) < 2
            constant = table["kappa_members"].isna() | table["kappa_majorities"].isna()
            why = "one member" if one else "kappa: all answers of a rater are alike"
            tables.append(table.assign(reason=np.where(constant, why, "")))
    return pd.concat(tables, ignore_index=True)


def _raters(first: _Population, second: _Population) -> dict[str, Callable[[int], _Raters]]:
    """Return the pairs of raters of `WHOSE`, as functions of the place of a scenario."""
    if first is second:
        return {"members": first.pair, "majorities": first.halves}

    def members(at: int) -> _Raters:
        one, other = first.answers[at], second.answers[at]
        a, b = np.repeat(one, other.shape[1], axis=1), np.tile(other, one.shape[1])
        return _Raters(a, b, a * b)

    def majorities(at: int) -> _Raters:
        a, b = first.majority(at)[:, None], second.majority(at)[:, None]
        return _Raters(a, b, a * b)

    return {"members": members, "majorities": majorities}


def _differences(populations: Sequence[_Population], scenarios: Sequence[str]) -> pd.DataFrame:
    """Return the accuracies of populations of models less people's, by size."""
    columns = ["population", "scenario", "stimuli"]
    columns += [f"{name}{end}" for name in ("consensus", "member") for end in ("", "_low", "_high")]
    people = populations[0]
    if people.name != PEOPLE:
        return pd.DataFrame(columns=columns)
    sizes = [len(label) for label in people.label]
    tables = []
    for one in populations[1:]:
        found = {
            "consensus": _by_scenario(_mean_of(one.right, people.right), sizes),
            "member": _by_scenario(_mean_of(one.member_right, people.member_right), sizes),
        }
        table = pd.DataFrame({"population": one.name, "scenario": [*scenarios, MEAN],
                              "stimuli": [*sizes, sum(sizes)]})  # fmt: skip
        table = pd.concat([table, _with_ends(found)], axis=1)
        order = np.argsort(-table["consensus"].to_numpy()[:-1], kind="stable")
        tables.append(table.iloc[[*order, len(order)]])
    return pd.concat(tables, ignore_index=True)[columns]


Compute = Callable[[int, Array], Array]
"""From the place of a scenario and weights of its stimuli (b, s) to a statistic (b,)."""


def _mean_of(values: Callable[[int], Array], less: Callable[[int], Array] | None = None) -> Compute:
    """Return the mean over stimuli of values, or of their differences."""

    def compute(at: int, weights: Array) -> Array:
        of = values(at) if less is None else values(at) - less(at)
        return np.asarray(weights @ of / weights.sum(axis=1))

    return compute


def _disagreement_of(raters: Callable[[int], _Raters]) -> Compute:
    def compute(at: int, weights: Array) -> Array:
        first, second, both = _means(raters(at), weights)
        return np.asarray((first + second - 2 * both).mean(axis=1))

    return compute


def _kappa_of(raters: Callable[[int], _Raters]) -> Compute:
    def compute(at: int, weights: Array) -> Array:
        kappa = kappa_from_fractions(*_means(raters(at), weights))
        return np.asarray(np.nansum(kappa, axis=1) / np.isfinite(kappa).sum(axis=1))

    return compute


def _means(raters: _Raters, weights: Array) -> tuple[Array, Array, Array]:
    first, second, both = (weights @ of / weights.sum(axis=1, keepdims=True) for of in raters)
    return first, second, both


Estimates = list[tuple[float, float, float]]
"""Value, and the ends of its interval, of each scenario and of their mean."""


def _by_scenario(
    compute: Compute,
    sizes: Sequence[int],
    scale: Scale = "identity",
    counts: bool = False,
) -> Estimates:
    """Return a statistic of each scenario, and the mean of all, with intervals over stimuli."""
    weights, strata = delete_one(sizes)
    with np.errstate(divide="ignore", invalid="ignore"):
        values = [compute(at, each) for at, each in enumerate(weights)]
    found: Estimates = []
    for at, of in enumerate(values):
        variance = jackknife(of[1:][strata == at], counts=counts)
        found.append((float(of[0]), *variance.interval(float(of[0]), scale=scale)))
    mean = np.mean(values, axis=0)
    variance = jackknife(mean[1:], strata, counts=counts)
    found.append((float(mean[0]), *variance.interval(float(mean[0]), scale=scale)))
    return found


def _with_ends(columns: dict[str, Estimates]) -> pd.DataFrame:
    """Return estimates as columns with their ends."""
    cells: dict[str, Any] = {}
    for name, estimates in columns.items():
        for end, values in zip(("", "_low", "_high"), zip(*estimates, strict=True), strict=True):
            cells[f"{name}{end}"] = values
    return pd.DataFrame(cells)
