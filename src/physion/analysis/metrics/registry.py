"""Registry of the metrics: the one definition of every number that compares a model with people.

A metric is one entry: a function of a `Sample`, decorated with `register_metric`. The tables of
scores (`models.score_tables`), of measures (`models.model_people`) and the report ask this
registry, so that a new metric appears in all of them. ``docs/how-to/add-a-metric.md``
shows how to add one.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from physion.analysis.sample import RESAMPLED, Array, Resampled, Sample
from physion.analysis.statistics.jackknife import Scale
from physion.core.registry import Registry

Compute = Callable[[Sample], Array]


@dataclass(frozen=True)
class Metric:
    """A number that is computed for every model, on one scenario or on all together.

    - ``name``: its column and its value of ``measure``;
    - ``compute``: from a `Sample` to values (b, m); undefined is NaN;
    - ``label``: its name in tables of the report (empty: the report leaves it out), ``heading`` in
      the report's table of scores;
    - ``definition``: one sentence for the report;
    - ``better``: which values are better; ``zero``: those nearest to 0; empty: none is;
    - ``needs``: ``outcome`` (of the trials), ``people`` (their averages by stimulus) or
      ``participants`` (their single answers);
    - ``resampled``: what an interval can be about; ``scale``: the one on which it is symmetric;
    - ``in_scores``, ``in_measures``: the tables that contain it: scores of models by stimulus,
      measures with single participants;
    - ``by_participant``: from a `Sample` to the value with each participant (n, m), if any;
    - ``two_people``: from a `Sample` to the value (b, 1) that one person has with another one in
      place of the model, if it is defined.
    """

    name: str
    compute: Compute
    label: str
    heading: str
    definition: str
    better: Literal["higher", "lower", "zero", ""]
    needs: Literal["outcome", "people", "participants"]
    resampled: tuple[Resampled, ...]
    scale: Scale
    in_scores: bool
    in_measures: bool
    by_participant: Compute | None
    two_people: Compute | None
    position: int

    @property
    def counts(self) -> bool:
        """Whether the metric is a function of counts of the model's answers (`jackknife`)."""
        return self.needs == "outcome"

    def __call__(self, sample: Sample) -> Array:
        """Return the values (b, m); division by zero gives NaN without a warning."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.compute(sample), dtype=np.float64)

    def of_two_people(self, sample: Sample) -> Array:
        """Return the values (b, 1) of one person with another; NaN where that is not defined."""
        if self.two_people is None:
            return np.full((len(sample.stimuli), 1), np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray(self.two_people(sample), dtype=np.float64)


metrics: Registry[Metric] = Registry("metric")
"""Every metric by name."""

_count = iter(range(1_000_000))


def register_metric(
    name: str,
    *,
    label: str,
    definition: str,
    better: Literal["higher", "lower", "zero", ""],
    needs: Literal["outcome", "people", "participants"],
    heading: str = "",
    resampled: tuple[Resampled, ...] = RESAMPLED,
    scale: Scale = "identity",
    in_scores: bool = False,
    in_measures: bool = False,
    by_participant: Compute | None = None,
    two_people: Compute | None = None,
) -> Callable[[Compute], Compute]:
    """Register the decorated function of a `Sample` as a metric; see `Metric` for the parameters.

    Tables list the metrics in the order in which they are registered.
    """

    def add(compute: Compute) -> Compute:
        metric = Metric(
            name=name,
            compute=compute,
            label=label,
            heading=heading or label,
            definition=definition,
            better=better,
            needs=needs,
            resampled=resampled,
            scale=scale,
            in_scores=in_scores,
            in_measures=in_measures,
            by_participant=by_participant,
            two_people=two_people,
            position=next(_count),
        )
        metrics.register(name)(metric)
        return compute

    return add


def all_metrics() -> list[Metric]:
    """Return every metric in the order of registration."""
    return sorted((metrics.get(name) for name in metrics.names()), key=lambda one: one.position)


def score_metrics() -> list[Metric]:
    """Return the metrics in the table of scores by stimulus."""
    return [metric for metric in all_metrics() if metric.in_scores]


def measure_metrics() -> list[Metric]:
    """Return the metrics in the table of measures with single participants."""
    return [metric for metric in all_metrics() if metric.in_measures]
