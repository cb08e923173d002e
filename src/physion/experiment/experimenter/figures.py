"""Geometry of the small histograms, which the template `figures.html` draws as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

WIDTH, HEIGHT, BASE = 260.0, 56.0, 12.0
"""Size of a histogram in SVG units; ``BASE`` is the height of the axis labels under the bars."""
GAP = 1.0


@dataclass(frozen=True)
class Bar:
    """Rectangle with a label that is shown on hover."""

    x: float
    y: float
    width: float
    height: float
    label: str


@dataclass(frozen=True)
class Mark:
    """Position on the axis: a tick label or a vertical line."""

    x: float
    label: str
    anchor: str = "middle"


@dataclass(frozen=True)
class Histogram:
    """Bars over an axis; ``label`` is a text description for screen readers."""

    bars: tuple[Bar, ...]
    ticks: tuple[Mark, ...]
    line: Mark | None
    label: str
    width: float = WIDTH
    height: float = HEIGHT
    base: float = BASE


def accuracy_histogram(accuracies: Sequence[float]) -> Histogram:
    """Return the histogram of accuracies (0..1) in bins of 5 %, with a line at chance (50 %)."""
    counts = [0] * 20
    for accuracy in accuracies:
        counts[min(19, int(accuracy * 20 + 1e-9))] += 1
    labels = [f"{step * 5}–{step * 5 + 5} %" for step in range(20)]
    ticks = (Mark(0, "0", "start"), Mark(WIDTH / 2, "50 %"), Mark(WIDTH, "100 %", "end"))
    label = f"Accuracy of {len(accuracies)} people; " + _mode(counts, labels)
    return Histogram(_bars(counts, labels), ticks, Mark(WIDTH / 2, "chance"), label)


_RT_LOW, _RT_HIGH, _RT_STEPS = 100.0, 20_000.0, 26


def rt_histogram(times_ms: Sequence[float]) -> Histogram:
    """Return the histogram of response times on a logarithmic axis from 0.1 to 20 s.

    The first and last bin include all shorter and longer times.
    """
    low, high = math.log(_RT_LOW), math.log(_RT_HIGH)
    counts = [0] * _RT_STEPS
    for time in times_ms:
        position = (math.log(max(time, 1e-3)) - low) / (high - low) * _RT_STEPS
        counts[min(_RT_STEPS - 1, max(0, int(position)))] += 1
    edges = [math.exp(low + (high - low) * i / _RT_STEPS) / 1000 for i in range(_RT_STEPS + 1)]
    labels = [f"{a:.2g}–{b:.2g} s" for a, b in pairwise(edges)]
    ticks = tuple(
        Mark(WIDTH * (math.log(ms) - low) / (high - low), f"{ms / 1000:g} s", anchor)
        for ms, anchor in ((100, "start"), (1000, "middle"), (10_000, "middle"))
    )
    label = f"Response times of {len(times_ms)} answers; " + _mode(counts, labels)
    return Histogram(_bars(counts, labels), ticks, None, label)


def _bars(counts: Sequence[int], labels: Sequence[str]) -> tuple[Bar, ...]:
    """Return the bars of the non-empty bins."""
    top, full = max([*counts, 1]), HEIGHT - BASE
    step = WIDTH / len(counts)
    bars = []
    for index, (count, label) in enumerate(zip(counts, labels, strict=True)):
        if count:
            # A minimum height keeps small counts visible.
            height = max(1.5, full * count / top)
            bars.append(
                Bar(round(index * step + GAP / 2, 2), round(full - height, 2),
                    round(step - GAP, 2), round(height, 2), f"{label}: {count}")
            )  # fmt: skip
    return tuple(bars)


def _mode(counts: Sequence[int], labels: Sequence[str]) -> str:
    """Return a text that names the bin with the highest count."""
    if not any(counts):
        return "none yet"
    return f"most at {labels[max(range(len(counts)), key=lambda index: counts[index])]}"
