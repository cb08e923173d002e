"""How often simple policies make red touch yellow with one push, in the environment of Gymnasium.

    python benchmarks/models/gym.py [--episodes 50] [--tries 20] [--write]

Policies: no push; a push drawn uniformly from all actions; and the first of 20 such pushes with
which red touches yellow in a simulation of the same scene, which is exact.
"""

from __future__ import annotations

import argparse
import time
from datetime import date
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from physion.core.tables import markdown_table
from physion.tasks.push import SCENARIOS, PushEnv

RESULT = Path(__file__).parents[1] / "results" / "gym.md"


def touches(env: PushEnv, seed: int, action: NDArray[np.float32]) -> bool:
    """Whether red touches yellow after a push."""
    env.reset(seed=seed)
    return env.step(action)[1] == 1.0


def successes(scenario: str, episodes: int, tries: int) -> list[int]:
    """Number of episodes in which each policy succeeds."""
    env, found = PushEnv(scenario), np.zeros(3, np.int64)
    for seed in range(episodes):
        pushes = np.random.default_rng(seed).uniform(-1, 1, (tries, 2)).astype(np.float32)
        outcomes = (touches(env, seed, push) for push in pushes)
        first = next(outcomes)
        found += [touches(env, seed, np.zeros(2, np.float32)), first, first or any(outcomes)]
    return [int(count) for count in found]


def main() -> None:
    """Print one row for each scenario."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--tries", type=int, default=20)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    n, started = options.episodes, time.perf_counter()
    counts = {scenario: successes(scenario, n, options.tries) for scenario in SCENARIOS}
    headings = ["scenario", "no push", "random push", f"best of {options.tries} simulated pushes"]
    cells = []
    for scenario, found in counts.items():
        cells.append([scenario, *(f"{count / n:.2f} ({count} of {n})" for count in found)])
    means = np.mean(list(counts.values()), axis=0) / n
    cells.append(["mean", *(f"{mean:.3f}" for mean in means)])
    command = f"python benchmarks/models/gym.py --episodes {n} --tries {options.tries}"
    seconds = time.perf_counter() - started
    text = (
        f"# One push: episodes in which red touches yellow\n`{command}`, "
        f"{date.today().isoformat()}, {seconds:.0f} s\n\n{markdown_table(headings, cells)}\n"
    )
    print(text)
    if options.write:
        RESULT.write_text(text, encoding="utf-8")


if __name__ == "__main__":
    main()
