"""Small figures as numbers: where bars stand. The template `figures.html` draws them as SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

WIDTH, HEIGHT, BASE = 260.0, 56.0, 12.0
"""Size of a histogram in its own units; ``BASE`` is the room under the bars for numbers."""
GAP = 1.0


@dataclass(frozen=True)
class Bar:
    """A rectangle and what it says when pointed at."""

    x: float
    y: float
    width: float
    height: float
    words: str


@dataclass(frozen=True)
class Mark:
    """A place on the axis: a number under it, or a line through the bars."""

    x: float
    words: str
    anchor: str = "middle"


@dataclass(frozen=True)
class Histogram:
    """Bars over an axis. ``words`` says in a sentence what is seen, for those who do not see it."""

    bars: tuple[Bar, ...]
    ticks: tuple[Mark, ...]
    line: Mark | None
    words: str
    width: float = WIDTH
    height: float = HEIGHT
    base: float = BASE


def accuracy_histogram(shares: Sequence[float]) -> Histogram:
    """How many people reached which accuracy, in steps of 5 %, with a line at chance (50 %)."""
    counts = [0] * 20
    for share in shares:
        counts[min(19, int(share * 20 + 1e-9))] += 1
    labels = [f"{step * 5}–{step * 5 + 5} %" for step in range(20)]
    ticks = (Mark(0, "0", "start"), Mark(WIDTH / 2, "50 %"), Mark(WIDTH, "100 %", "end"))
    words = f"Accuracy of {len(shares)} people; " + _fullest(counts, labels)
    return Histogram(_bars(counts, labels), ticks, Mark(WIDTH / 2, "chance"), words)


_RT_LOW, _RT_HIGH, _RT_STEPS = 100.0, 20_000.0, 26


def rt_histogram(times_ms: Sequence[float]) -> Histogram:
    """How many answers took how long, on a logarithmic axis from 0.1 to 20 s; the ends hold all
    that lies beyond them."""
    low, high = math.log(_RT_LOW), math.log(_RT_HIGH)
    counts = [0] * _RT_STEPS
    for time in times_ms:
        place = (math.log(max(time, 1e-3)) - low) / (high - low) * _RT_STEPS
        counts[min(_RT_STEPS - 1, max(0, int(place)))] += 1
    edges = [math.exp(low + (high - low) * i / _RT_STEPS) / 1000 for i in range(_RT_STEPS + 1)]
    labels = [f"{a:.2g}–{b:.2g} s" for a, b in pairwise(edges)]
    ticks = tuple(
        Mark(WIDTH * (math.log(ms) - low) / (high - low), f"{ms / 1000:g} s", anchor)
        for ms, anchor in ((100, "start"), (1000, "middle"), (10_000, "middle"))
    )
    words = f"Response times of {len(times_ms)} answers; " + _fullest(counts, labels)
    return Histogram(_bars(counts, labels), ticks, None, words)


def _bars(counts: Sequence[int], labels: Sequence[str]) -> tuple[Bar, ...]:
    top, room = max([*counts, 1]), HEIGHT - BASE
    step = WIDTH / len(counts)
    bars = []
    for place, (count, label) in enumerate(zip(counts, labels, strict=True)):
        if count:
            # Whoever is alone beside many is still seen.
            height = max(1.5, room * count / top)
            bars.append(
                Bar(round(place * step + GAP / 2, 2), round(room - height, 2),
                    round(step - GAP, 2), round(height, 2), f"{label}: {count}")
            )  # fmt: skip
    return tuple(bars)


def _fullest(counts: Sequence[int], labels: Sequence[str]) -> str:
    if not any(counts):
        return "none yet"
    return f"most at {labels[max(range(len(counts)), key=lambda place: counts[place])]}"
