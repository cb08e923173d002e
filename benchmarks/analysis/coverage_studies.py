"""Simulated studies for `interval_coverage.py`, and counts of how often intervals hold.

The logit of P(yes) of a person at a stimulus is s (m + A b) + L a: s is 1 at contacts and -1
otherwise, m normal over stimuli (easiness), a and b standard normal over people (leaning to yes,
and ability). Models:

- perfect: P(contact) is the fraction of yes of infinitely many people;
- good, poor: logit 0.8 s m + 1.0 e and 0.3 s m + 1.5 e with e standard normal;
- outcome: P(contact) 0.95 at contacts and 0.05 otherwise, reversed at a sixth of the stimuli.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from physion.analysis.people.measures import ScenarioAnswers
from physion.analysis.sample import Resampled
from physion.analysis.with_participants import Models
from physion.core.seeds import generator

F64 = NDArray[np.float64]
Size = tuple[int, int]
"""Numbers of people and of stimuli."""

MODELS = ("perfect", "good", "poor", "outcome")
SCENARIOS = 8


@dataclass(frozen=True)
class Population:
    """Distribution of stimuli and people.

    - ``contact_every``: one of so many stimuli is a contact;
    - ``easiness``, ``easiness_sd``: of m;
    - ``ability``, ``leaning``: A and L, standard deviations over people in logits.
    """

    contact_every: int
    easiness: float
    easiness_sd: float
    ability: float
    leaning: float


POPULATIONS = {
    "even": Population(2, 1.2, 1.3, 0.4, 0.3),
    "rare": Population(4, 0.8, 0.9, 0.6, 0.6),
}
"""``even``: half of the stimuli are contacts; ``rare``: a quarter, harder, people differ more."""


@dataclass(frozen=True)
class Study:
    """Answers of people (n, s) to stimuli with labels (s,) and easiness (s,), and P(contact) of
    `MODELS` (m, s).
    """

    yes: F64
    label: F64
    easiness: F64
    p_contact: F64

    @property
    def p_yes(self) -> F64:
        return np.asarray(self.yes.mean(axis=0))

    @property
    def right(self) -> F64:
        """Fraction of people who are right, (s,)."""
        return np.where(self.label == 1, self.p_yes, 1 - self.p_yes)

    def answers(self, scenario: str = "drop") -> ScenarioAnswers:
        people, stimuli = self.yes.shape
        names = tuple(f"p{k:03d}" for k in range(people))
        stimulus = tuple(f"{scenario} {k:03d}" for k in range(stimuli))
        nothing = np.full(self.yes.shape, np.nan)
        return ScenarioAnswers(scenario, names, names, stimulus, self.yes, self.label, nothing)

    def models(self) -> Models:
        return Models(MODELS, self.p_contact, (self.p_contact > 0.5).astype(np.float64))

    def test(self, rng: np.random.Generator) -> pd.DataFrame:
        """Test rows as `participants.Responses` has them, each person with an own order."""
        people, stimuli = self.yes.shape
        person = np.repeat(np.arange(people), stimuli)
        order = rng.permuted(np.tile(np.arange(stimuli), (people, 1)), axis=1)
        name = np.char.add("p", np.char.zfill(person.astype(str), 3))
        yes = self.yes.ravel().astype(bool)
        label = np.tile(self.label.astype(bool), people)
        return pd.DataFrame(
            {
                "scenario": "drop",
                "session": name,
                "participant": name,
                "phase": "test",
                "stimulus": np.tile(np.arange(stimuli).astype(str), people),
                "trial": order.ravel(),
                "yes": yes,
                "label": label,
                "correct": yes == label,
                "log_rt": np.nan,
                "rt_ms": np.nan,
                "buttons": np.where(person % 2, "no-yes", "yes-no"),
            }
        )


def studies(
    drawn: Resampled, size: Size, repeats: int, population: Population = POPULATIONS["even"]
) -> Iterator[Study]:
    """Simulate studies in which people, stimuli, or both differ from one to the next."""
    people, stimuli = size
    fixed = generator("coverage, fixed", drawn, people, stimuli)
    rng = generator("coverage", drawn, people, stimuli)
    pool = generator("coverage, all people").normal(size=(2, 2000))
    persons = fixed.normal(size=(2, people))
    scenes = fixed.normal(size=(4, stimuli))
    sign = np.where(np.arange(stimuli) % population.contact_every == 0, 1.0, -1.0)
    ability, leaning = population.ability, population.leaning
    for _ in range(repeats):
        if drawn != "stimuli":
            persons = rng.normal(size=(2, people))
        if drawn != "people":
            scenes = rng.normal(size=(4, stimuli))
        easy = population.easiness + population.easiness_sd * scenes[0]

        def p_yes(persons: F64, easy: F64 = easy) -> F64:
            return logistic(sign * (easy + ability * persons[1, :, None])
                            + leaning * persons[0, :, None])  # fmt: skip

        reversed_ = scenes[3] < -0.967
        p_contact = np.stack(
            [
                p_yes(pool).mean(0),
                logistic(0.8 * sign * easy + scenes[1]),
                logistic(0.3 * sign * easy + 1.5 * scenes[2]),
                np.where((sign > 0) != reversed_, 0.95, 0.05),
            ]
        )
        p = p_yes(persons)
        yes = (rng.random(p.shape) < p).astype(np.float64)
        yield Study(yes, (sign > 0).astype(np.float64), easy, p_contact)


def logistic(x: F64) -> F64:
    return np.asarray(1 / (1 + np.exp(-x)))


class Coverage:
    """Values, lows and highs of intervals over repeats, by a name.

    ``only``: keep the intervals whose name contains one of these texts; empty: all.
    """

    def __init__(self, only: Sequence[str] = (), population: str = "even") -> None:
        self.only = tuple(only)
        self.population = POPULATIONS[population]
        self.rows: dict[tuple[str, str, str], list[tuple[float, float, float]]] = {}
        self.truths: dict[tuple[str, str, str], float] = {}

    def studies(self, drawn: Resampled, size: Size, repeats: int) -> Iterator[Study]:
        return studies(drawn, size, repeats, self.population)

    def wants(self, *names: str) -> bool:
        """Return whether an interval of one of these names is kept."""
        return not self.only or any(text in name for text in self.only for name in names)

    def add(self, what: str, drawn: str, size: Size | str, value: float, low: float, high: float,
            truth: float | None = None) -> None:  # fmt: skip
        """Add the interval of one repeat; ``truth``: what it is about, if not the mean value."""
        if not self.wants(what):
            return
        named = size if isinstance(size, str) else f"{size[0]} x {size[1]}"
        self.rows.setdefault((what, drawn, named), []).append((value, low, high))
        if truth is not None:
            self.truths[what, drawn, named] = truth

    def table(self) -> pd.DataFrame:
        """One row a name: ``repeats``, ``value`` (what the interval is about), ``width`` (mean),
        ``inside`` (%), of which the interval lies ``below`` or ``above`` the value, and
        ``undefined``.
        """
        records = []
        for key, rows in self.rows.items():
            value, low, high = np.array(rows).T
            truth = self.truths.get(key, float(np.nanmean(value)))
            known = np.isfinite(low) & np.isfinite(high)
            below, above = high[known] < truth, low[known] > truth
            records.append(
                {
                    **dict(zip(("what", "drawn", "size"), key, strict=True)),
                    "repeats": len(rows),
                    "value": truth,
                    "width": np.mean(high[known] - low[known]),
                    "inside": 100 * np.mean(~(below | above)),
                    "below": 100 * np.mean(below),
                    "above": 100 * np.mean(above),
                    "undefined": int(np.sum(~known)),
                }
            )
        return pd.DataFrame(records)
