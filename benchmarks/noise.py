"""Fit the noise of `noisy-simulation` to outcomes or to people, and test it on other scenes.

    python benchmarks/noise.py [--samples 12] [--rounds 2] [--limit N] [--workers 2] [--write]

Scenes are the official ones of the package that people saw. Configurations are divided into two
halves by a hash of their names: levels are fitted on one half and tested on the other. With k of n
simulations touching, P(contact) is (1 - l) (k + 1/2) / (n + 1) + l / 2 with the lapse rate l.

- Fitted to outcomes: the sum of log P(recorded outcome).
- Fitted to people: the sum of m (y log P + (1 - y) log(1 - P)) / 10 over stimuli with m people, a
  fraction y of whom said yes (binomial likelihood; the division changes no maximum).

The search changes one level at a time to the values of its list, for ``--rounds`` rounds. All
values use the same random numbers. The test half gives accuracy, r with people, and r beyond the
outcome (partial correlation given the recorded outcome) with a 95 % bootstrap interval over
stimuli.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import os
import platform
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from physion.analysis.statistics.correlation import correlation_within_groups
from physion.analysis.tables.responses import read_humans
from physion.compute.local import LocalExecutor
from physion.data import official
from physion.models.noisy_simulation import cut_trial
from physion.models.state_noise import NoiseLevels, simulate_contacts
from physion.physics.engine import make_engine, simulate
from physion.scenes.scene import Scene
from physion.seeds import generator, stable_hash
from physion.stimulus_names import canonical_name

RESULTS = Path(__file__).parent / "results" / "noise.md"
GRID = {
    "velocity": (0.1, 0.0, 0.05, 0.2, 0.4, 0.8, 1.6),
    "position": (0.01, 0.0, 0.02, 0.05, 0.1, 0.2),
    "contact": (0.0, 0.1, 0.2, 0.4, 0.8),
    "angular_velocity": (0.0, 0.5, 1.0, 2.0, 4.0),
    "rotation": (0.0, 0.05, 0.1, 0.2),
    "friction": (0.0, 0.1, 0.3, 1.0),
}
"""Values of the levels that are fitted, the default first. Mass has the same level as friction, and
height that of position."""
LAPSES = tuple(np.round(np.linspace(0.0, 0.9, 46), 3))


@dataclass(frozen=True)
class Task:
    """Simulations of one scene with one set of levels."""

    scene: Scene
    levels: NoiseLevels
    samples: int


def fraction(task: Task) -> float:
    """Return the fraction of simulations of a scene in which agent and patient touch."""
    engine = make_engine("physion")
    trial = cut_trial(task.scene, simulate(task.scene, engine=engine))
    return float(np.mean(simulate_contacts(trial, task.levels, 1.0, task.samples, 0, engine)))


def levels_of(chosen: dict[str, float]) -> NoiseLevels:
    """Return the levels of a point of the search."""
    tied = {"mass": max(0.1, chosen["friction"]), "vertical": chosen["position"]}
    return NoiseLevels(**chosen, **tied)


def probabilities(
    fractions: NDArray[np.float64], samples: int, lapse: float
) -> NDArray[np.float64]:
    """Return P(contact) of every scene."""
    return (1 - lapse) * (fractions * samples + 0.5) / (samples + 1) + lapse / 2


def log_likelihood(p: NDArray[np.float64], y: NDArray[np.float64], m: NDArray[np.float64]) -> float:
    """Return the sum of m (y log p + (1 - y) log(1 - p))."""
    return float(np.sum(m * (y * np.log(p) + (1 - y) * np.log(1 - p))))


def partial_r(x: NDArray[np.float64], y: NDArray[np.float64], z: NDArray[np.float64]) -> float:
    """Return the correlation of x and y given the outcome z (0 or 1)."""
    groups = []
    for outcome in (0.0, 1.0):
        u, v = x[z == outcome], y[z == outcome]
        sums = (len(u), u.sum(), v.sum(), u @ u, v @ v, u @ v)
        groups.append(tuple(np.array([value], np.float64) for value in sums))
    return float(correlation_within_groups(groups)[0])  # type: ignore[arg-type]


class Search:
    """Scenes, answers, and the fractions of all levels tried so far."""

    def __init__(self, samples: int, workers: int, limit: int | None) -> None:
        data = official()
        humans = read_humans(data.humans).set_index("stimulus")
        trials = [
            trial for trial in data.trials if canonical_name(trial.scene.name) in humans.index
        ]
        trials.sort(key=lambda trial: stable_hash("noise", trial.scene.name))
        trials = trials[:limit]
        names = [canonical_name(trial.scene.name) for trial in trials]
        self.scenes = [trial.scene for trial in trials]
        self.outcome = np.array([float(trial.outcome.contact) for trial in trials])
        accuracy = humans.loc[names, "accuracy"].to_numpy(float)
        self.people = np.where(self.outcome == 1, accuracy, 1 - accuracy)
        self.count = humans.loc[names, "count"].to_numpy(float)
        configurations = [str(trial.scene.parameters.get("configuration")) for trial in trials]
        self.half = np.array([stable_hash("half", name) % 2 for name in configurations])
        self.samples, self.executor = samples, LocalExecutor(workers=workers)
        self._known: dict[NoiseLevels, NDArray[np.float64]] = {}

    def fractions(self, levels: NoiseLevels) -> NDArray[np.float64]:
        """Return the fractions of all scenes."""
        self.simulate([levels])
        return self._known[levels]

    def simulate(self, wanted: Sequence[NoiseLevels]) -> None:
        """Simulate all scenes with the levels that are not known yet, in one go."""
        missing = [levels for levels in dict.fromkeys(wanted) if levels not in self._known]
        tasks = {
            f"{place} {scene.name}": Task(scene, levels, self.samples)
            for place, levels in enumerate(missing)
            for scene in self.scenes
        }
        done = {o.key: o.value for o in self.executor.map(fraction, tasks)} if tasks else {}
        for place, levels in enumerate(missing):
            self._known[levels] = np.array([done[f"{place} {s.name}"] for s in self.scenes])

    def fit(self, target: str, half: int, rounds: int) -> tuple[dict[str, float], float]:
        """Return the levels and the lapse rate with the highest likelihood on a half."""
        chosen = {name: values[0] for name, values in GRID.items()}
        best, lapse = self._score(chosen, target, half)
        for _ in range(rounds):
            before = best
            for name, values in GRID.items():
                self.simulate([levels_of({**chosen, name: value}) for value in values])
                for value in values:
                    trial = {**chosen, name: value}
                    score, rate = self._score(trial, target, half)
                    if score > best:
                        best, chosen, lapse = score, trial, rate
            print(f"  {target}, half {half}: {best:.1f} {chosen} lapse {lapse}", flush=True)
            if best == before:
                break
        return chosen, lapse

    def _score(self, chosen: dict[str, float], target: str, half: int) -> tuple[float, float]:
        rows = self.half == half
        fractions = self.fractions(levels_of(chosen))[rows]
        y = (self.people if target == "people" else self.outcome)[rows]
        m = self.count[rows] / 10 if target == "people" else np.ones(rows.sum())
        scores = [
            (log_likelihood(probabilities(fractions, self.samples, lapse), y, m), lapse)
            for lapse in LAPSES
            if target == "people" or lapse <= 0.5
        ]
        return max(scores)

    def row(self, target: str, chosen: dict[str, float], lapse: float, half: int) -> str:
        """Return a line of the table: fitted on ``half``, tested on the other one."""
        rows = self.half != half
        p = probabilities(self.fractions(levels_of(chosen))[rows], self.samples, lapse)
        y, z = self.people[rows], self.outcome[rows]
        rng = generator("noise bootstrap", half)
        draws = [rng.integers(len(p), size=len(p)) for _ in range(2000)]
        beyond = [partial_r(p[d], y[d], z[d]) for d in draws]
        low, high = np.quantile(beyond, [0.025, 0.975])
        levels = ", ".join(f"{name} {value:g}" for name, value in chosen.items() if value)
        right = np.mean((p > 0.5) == (z == 1))
        r = np.corrcoef(p, y)[0, 1]
        return (
            f"| {target} | {half} | {levels}, lapse {lapse:g} | {rows.sum()} | {right:.3f} | "
            f"{r:.3f} | {partial_r(p, y, z):.3f} ({low:.3f} to {high:.3f}) |"
        )


def main() -> None:
    """Fit to outcomes and to people on each half, and print or write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--limit", type=int)
    parser.add_argument("--workers", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    start = time.time()
    search = Search(options.samples, options.workers, options.limit)
    default = {name: values[0] for name, values in GRID.items()}
    lines = [
        "| fitted to | half | levels | test stimuli | accuracy | r | r beyond the outcome |",
        "|---|---|---|---|---|---|---|",
        *(search.row("default, not fitted", default, 0.0, half) for half in (0, 1)),
    ]
    for target in ("outcomes", "people"):
        for half in (0, 1):
            chosen, lapse = search.fit(target, half, options.rounds)
            lines.append(search.row(target, chosen, lapse, half))
    table = "\n".join(lines)
    command = " ".join(
        f"--{name} {value}" for name, value in vars(options).items() if name != "write"
    )
    text = (
        f"\n## {datetime.date.today()}, {platform.machine()}, "
        f"`python benchmarks/noise.py {command}`"
        f"\n\n{len(search.scenes)} scenes, {len(search._known)} sets of levels, "
        f"{time.time() - start:.0f} s\n\n{table}\n"
    )
    print(text)
    if options.write:
        RESULTS.parent.mkdir(exist_ok=True)
        head = (
            RESULTS.read_text() if RESULTS.exists() else f"# Noise of noisy-simulation\n{_intro()}"
        )
        RESULTS.write_text(head + text)


def _intro() -> str:
    fields = ", ".join(field.name for field in dataclasses.fields(NoiseLevels))
    return (
        "# Noise of noisy-simulation\n\nWhat is fitted and how: `benchmarks/noise.py`. Levels (see "
        f"`physion.models.state_noise.NoiseLevels`): {fields}.\n"
    )


if __name__ == "__main__":
    main()
