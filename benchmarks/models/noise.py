"""Fit the noise of `noisy-simulation` to outcomes or to people, and test it on other scenes.

    python benchmarks/models/noise.py [--sets 32] [--samples 10] [--scenes N] [--cache FILE]
        [--write]

Scenes are the official ones of the package that people saw. Configurations are divided into two
halves by a hash of their names: levels are fitted on one half and tested on the other. With k of n
simulations touching, P(contact) is (1 - l) (k + 1/2) / (n + 1) + l / 2 with the lapse rate l.

- Fitted to outcomes: the sum of log P(recorded outcome).
- Fitted to people: the sum of m (y log P + (1 - y) log(1 - P)) / 10 over stimuli with m people, a
  fraction y of whom said yes (binomial likelihood; the division changes no maximum).

The search is successive halving, since one set of levels on all scenes takes minutes. Sets are the
default, each level of `GRID` alone, and random ones. All are simulated on the smallest subset of
`STAGES`, the best of every fit again on the next one, and the last few on all scenes (or on a
subset of ``--scenes``, which is then also the one of the test). Subsets have equally many scenes of
every half, scenario and outcome, and none with cloth, which would take most of the time. All sets
use the same random numbers.

The test half gives accuracy, r with people, r beyond the outcome (partial correlation given the
recorded outcome), and the same given outcome and scenario, with 95 % intervals of a bootstrap over
configurations. Rows of both halves have every scene once, with the levels fitted on the half it is
not in. In the ablation the same levels are used, but log density and log friction of movable bodies
are drawn from their distribution over the official scenes that are not tested.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from noise_simulations import F64, Simulations
from physion.analysis.statistics.agreement import correlation_within_groups
from physion.compute.tasks import processor
from physion.core.seeds import generator
from physion.models.noisy_simulation import NoiseLevels

RESULTS = Path(__file__).parents[1] / "results" / "noise.md"
GRID = {
    "velocity": (0.1, 0.0, 0.05, 0.2, 0.4, 0.8),
    "position": (0.01, 0.0, 0.02, 0.05, 0.1, 0.2),
    "contact": (0.0, 0.1, 0.2, 0.4, 0.8),
    "angular_velocity": (0.0, 0.5, 1.0, 2.0, 4.0),
    "rotation": (0.0, 0.05, 0.1, 0.2),
    "friction": (0.0, 0.1, 0.3, 1.0),
}
"""Values of the levels that are fitted, the default first. Mass has the same level as friction (at
least 0.1), and height that of position."""
LAPSES = tuple(np.round(np.linspace(0.0, 0.9, 46), 3))
STAGES = ((112, 6, 4), (224, 6, 1))
"""Scenes and simulations per scene of the stages before the last, and how many sets of levels of
each fit go on to the next stage."""
FITS = tuple((target, half) for target in ("outcomes", "people") for half in (0, 1))


@dataclass(frozen=True)
class Fit:
    """Levels and lapse rate fitted to a target on a half of the configurations."""

    target: str
    half: int
    levels: NoiseLevels
    lapse: float


def levels_of(chosen: dict[str, float]) -> NoiseLevels:
    """Return the levels of a point of the search."""
    tied = {"mass": max(0.1, chosen["friction"]), "vertical": chosen["position"]}
    return NoiseLevels(**chosen, **tied)


def first_sets(number: int) -> list[NoiseLevels]:
    """Return ``number`` sets of levels: the default, levels changed alone, then random ones."""
    default = {name: values[0] for name, values in GRID.items()}
    sets = [{**default, name: values[-2]} for name, values in GRID.items()]
    rng = generator("noise levels")
    while len(sets) < number:
        sets.append({name: values[rng.integers(len(values))] for name, values in GRID.items()})
    return [NoiseLevels(), *dict.fromkeys(levels_of(chosen) for chosen in sets[: number - 1])]


def probabilities(fractions: F64, samples: int, lapse: float) -> F64:
    """Return P(contact) of every scene."""
    return (1 - lapse) * (fractions * samples + 0.5) / (samples + 1) + lapse / 2


def log_likelihood(p: F64, y: F64, m: F64) -> float:
    """Return the sum of m (y log p + (1 - y) log(1 - p))."""
    return float(np.sum(m * (y * np.log(p) + (1 - y) * np.log(1 - p))))


def partial_r(x: F64, y: F64, groups: NDArray[np.str_]) -> float:
    """Return the correlation of the deviations of x and y from their means over each group."""
    sums = []
    for group in np.unique(groups):
        u, v = x[groups == group], y[groups == group]
        values = (len(u), u.sum(), v.sum(), u @ u, v @ v, u @ v)
        sums.append(tuple(np.array([value], np.float64) for value in values))
    return float(correlation_within_groups(sums)[0])  # type: ignore[arg-type]


class Search:
    """Successive halving over sets of levels, for all fits together."""

    def __init__(self, simulations: Simulations, places: NDArray[np.int64], samples: int) -> None:
        self.simulations, self.places, self.samples = simulations, places, samples
        self.start = time.time()

    def run(self, sets: Sequence[NoiseLevels]) -> list[Fit]:
        """Return the best levels of every fit."""
        for size, samples, kept in STAGES:
            places = self.simulations.subset(size)
            scored = self._scores(sets, places, samples)
            best = [levels for fit in FITS for _, _, levels in scored[fit][:kept]]
            sets = list(dict.fromkeys([sets[0], *best]))
        scored = self._scores(sets, self.places, self.samples)
        return [Fit(*fit, levels=scored[fit][0][2], lapse=scored[fit][0][1]) for fit in FITS]

    def _scores(
        self, sets: Sequence[NoiseLevels], places: NDArray[np.int64], samples: int
    ) -> dict[tuple[str, int], list[tuple[float, float, NoiseLevels]]]:
        """Return for each fit likelihood, lapse rate and levels of all sets, the best first."""
        scores: dict[tuple[str, int], list[tuple[float, float, NoiseLevels]]]
        scores = {fit: [] for fit in FITS}
        for number, levels in enumerate(sets, start=1):
            fractions = self.simulations.fractions(places, levels, samples)
            for fit in FITS:
                scores[fit].append((*self._score(fractions, places, samples, *fit), levels))
            best = ", ".join(f"{scores[fit][-1][0]:.1f}" for fit in FITS)
            print(
                f"{time.time() - self.start:6.0f} s, {len(places)} scenes, set {number} of "
                f"{len(sets)}: {best}; {describe(levels)}",
                flush=True,
            )
        return {fit: sorted(rows, key=lambda row: -row[0]) for fit, rows in scores.items()}

    def _score(
        self, fractions: F64, places: NDArray[np.int64], samples: int, target: str, half: int
    ) -> tuple[float, float]:
        answers = self.simulations.answers
        rows = answers.half[places] == half
        chosen = places[rows]
        y = (answers.people if target == "people" else answers.outcome)[chosen]
        m = answers.count[chosen] / 10 if target == "people" else np.ones(len(chosen))
        return max(
            (log_likelihood(probabilities(fractions[rows], samples, lapse), y, m), lapse)
            for lapse in LAPSES
        )


def describe(levels: NoiseLevels) -> str:
    """Return the levels that are not 0."""
    return ", ".join(f"{k} {v:g}" for k, v in dataclasses.asdict(levels).items() if v)


class Tests:
    """Scores of fitted levels on the configurations they were not fitted on."""

    def __init__(self, simulations: Simulations, places: NDArray[np.int64], samples: int) -> None:
        self.simulations, self.places, self.samples = simulations, places, samples
        self.answers = simulations.answers.at(places)

    def predict(self, levels: NoiseLevels, lapse: float, *, prior: bool) -> F64:
        """Return P(contact) of all tested scenes."""
        fractions = self.simulations.fractions(self.places, levels, self.samples, prior=prior)
        return probabilities(fractions, self.samples, lapse)

    def rows(self, name: str, fits: Sequence[Fit], *, prior: bool = False) -> list[str]:
        """Return a line for each half of the tested configurations, and one for both."""
        p = np.zeros(len(self.places))
        lines = []
        for fit in fits:
            tested = self.answers.half != fit.half
            p[tested] = self.predict(fit.levels, fit.lapse, prior=prior)[tested]
            text = f"{describe(fit.levels)}; lapse {fit.lapse:g}"
            if not prior:
                lines.append(self._row(name, f"{fit.half}", text, p, tested))
        both = np.ones(len(p), np.bool_)
        return [*lines, self._row(name, "the other", "as above", p, both)]

    def _row(self, name: str, half: str, text: str, p: F64, tested: NDArray[np.bool_]) -> str:
        answers = self.answers
        p, y, z = p[tested], answers.people[tested], answers.outcome[tested]
        both = np.char.add(answers.scenario[tested], z.astype(str))
        names = answers.configuration[tested]
        beyond = self._interval(p, y, z.astype(str), names)
        within = self._interval(p, y, both, names)
        right, r = np.mean((p > 0.5) == (z == 1)), np.corrcoef(p, y)[0, 1]
        return (
            f"| {name} | {half} | {text} | {len(p)} | {right:.3f} | {r:.3f} | {beyond} | {within} |"
        )

    def _interval(self, p: F64, y: F64, groups: NDArray[np.str_], names: NDArray[np.str_]) -> str:
        """Return r within groups and its interval, of a bootstrap over configurations."""
        members = [np.flatnonzero(names == name) for name in np.unique(names)]
        rng = generator("noise bootstrap")
        values = []
        for _ in range(2000):
            drawn = rng.integers(len(members), size=len(members))
            rows = np.concatenate([members[i] for i in drawn])
            values.append(partial_r(p[rows], y[rows], groups[rows]))
        low, high = np.nanquantile(values, [0.025, 0.975])
        return f"{partial_r(p, y, groups):.3f} ({low:.3f} to {high:.3f})"


HEAD = """\
| fitted to | fitted on half | levels | test stimuli | accuracy | r with people | r beyond the \
outcome | r beyond outcome and scenario |
|---|---|---|---|---|---|---|---|"""


def table(tests: Tests, fits: Sequence[Fit]) -> str:
    """Return the lines of the table: default, fits, and the ablation."""
    default = [Fit("", half, NoiseLevels(), 0.0) for half in (0, 1)]
    lines = [HEAD, *tests.rows("nothing (default)", default)]
    for target in ("outcomes", "people"):
        lines += tests.rows(target, [fit for fit in fits if fit.target == target])
    lines += tests.rows("nothing; masses and frictions from priors", default, prior=True)
    for target in ("outcomes", "people"):
        chosen = [fit for fit in fits if fit.target == target]
        lines += tests.rows(f"{target}; masses and frictions from priors", chosen, prior=True)
    return "\n".join(lines)


def main() -> None:
    """Fit to outcomes and to people on each half, and print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sets", type=int, default=32)
    parser.add_argument("--samples", type=int, default=10)
    parser.add_argument("--scenes", type=int)
    parser.add_argument("--cache", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    start = time.process_time()
    simulations = Simulations(options.cache)
    places = np.arange(len(simulations.scenes))
    if options.scenes is not None:
        places = simulations.subset(options.scenes)
    fits = Search(simulations, places, options.samples).run(first_sets(options.sets))
    lines = table(Tests(simulations, places, options.samples), fits)
    prior = ", ".join(f"{k} {v:.3f}" for k, v in dataclasses.asdict(simulations.prior).items())
    stages = "; ".join(
        f"{size} scenes without cloth, {samples} simulations each, {kept} best of each fit go on"
        for size, samples, kept in STAGES
    )
    subset = "" if options.scenes is None else f" --scenes {options.scenes}"
    which = "all" if options.scenes is None else f"{len(places)} (without cloth)"
    text = (
        f"\n## {datetime.date.today()}, {processor()}, `python benchmarks/models/noise.py "
        f"--sets {options.sets} --samples {options.samples}{subset}`\n\n"
        f"{len(simulations.scenes)} scenes that people saw; {options.sets} sets of levels. "
        f"Stages: {stages}; at last, and in the test, {which} scenes, {options.samples} "
        f"simulations each. {simulations.number} simulations, {simulations.made} of them in this "
        f"process ({time.process_time() - start:.0f} s of one core), the others from the cache of "
        f"an earlier one. Prior of the logarithms: {prior}.\n\n{lines}\n"
    )
    print(text)
    if options.write:
        RESULTS.parent.mkdir(exist_ok=True)
        head = RESULTS.read_text() if RESULTS.exists() else _intro()
        RESULTS.write_text(head + text)


def _intro() -> str:
    return (
        "# Noise of noisy-simulation\n\nWhat is fitted and how: "
        "`benchmarks/models/noise.py`. Levels: see "
        "`physion.models.noisy_simulation.NoiseLevels`.\n"
    )


if __name__ == "__main__":
    main()
