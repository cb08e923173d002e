"""How long statistics of agreement take.

    OMP_NUM_THREADS=1 python benchmarks/analysis/agreement.py

Side by side in one run: Cohen's kappa of every pair of 100 people who answered 150 stimuli, by
scikit-learn pair by pair and by `physion.analysis.statistics.agreement` at once, with the largest
difference of the two; then 1000 bootstraps of the mean pairwise kappa, drawing people, stimuli or
both; then 20 models beside the 100 people with every interval in each of eight scenarios, from
tables, with the tests of all pairs of models, and zones. Times are the best of
several runs, but for the loop and the eight scenarios, which run once. ``--write`` puts them into
benchmarks/results/agreement.json.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import time
import warnings
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pandas as pd
import sklearn
from sklearn.metrics import cohen_kappa_score

from physion.analysis.compare import compare_everywhere
from physion.analysis.intervals import Bootstrap
from physion.analysis.people.measures import ScenarioAnswers
from physion.analysis.statistics.agreement import pair_values, pairwise_kappa, resampled_mean_kappa
from physion.compute.tasks import processor
from physion.core.names import SCENARIOS

RESULTS = Path(__file__).parents[1] / "results" / "agreement.json"
PEOPLE, STIMULI, MODELS, RESAMPLES = 100, 150, 20, 1000
TARGETS = {"times_faster": 1000.0, "largest_difference": 1e-12, "bootstrap_seconds": 0.5}


def people(seed: int = 0) -> ScenarioAnswers:
    """People who answer stimuli of different difficulty."""
    generator = np.random.default_rng(seed)
    label = (np.arange(STIMULI) % 2).astype(float)
    right = 1 / (1 + np.exp(-generator.normal(1, 1.2, STIMULI)))
    correct = generator.random((PEOPLE, STIMULI)) < right
    yes = np.where(correct, label, 1 - label)
    names = tuple(f"p{k:03d}" for k in range(PEOPLE))
    stimuli = tuple(f"s{k:03d}" for k in range(STIMULI))
    return ScenarioAnswers("drop", names, names, stimuli, yes, label, np.full_like(yes, np.nan))


def everywhere() -> Callable[[], object]:
    """The whole comparison of eight scenarios, ready to be run; the tables are made before."""
    tests, predictions = [], []
    generator = np.random.default_rng(2)
    for seed, scenario in enumerate(SCENARIOS):
        made = people(seed)
        rows, columns = np.indices(made.yes.shape)
        label = made.label[columns.ravel()] == 1
        yes = made.yes.ravel() == 1
        table = pd.DataFrame({"scenario": scenario, "yes": yes, "label": label, "log_rt": 7.0})
        table["session"] = [f"{scenario}-{made.sessions[k]}" for k in rows.ravel()]
        table["stimulus"] = [f"{scenario}-{made.stimuli[k]}" for k in columns.ravel()]
        tests.append(table.assign(participant=table["session"], correct=yes == label))
        for model in range(MODELS):
            p = generator.random(STIMULI)
            stimuli = [f"{scenario}-{name}" for name in made.stimuli]
            predictions.append(
                pd.DataFrame({"model": f"m{model}", "stimulus": stimuli, "p_contact": p,
                              "predicted": p > 0.5})
            )  # fmt: skip
    test, rows_of_models = pd.concat(tests), pd.concat(predictions)
    return lambda: compare_everywhere(rows_of_models, test)


def by_scikit_learn(yes: np.ndarray) -> np.ndarray:
    """The loop over all pairs."""
    return np.array(
        [cohen_kappa_score(yes[i], yes[j]) for i in range(len(yes)) for j in range(i + 1, len(yes))]
    )


def best(run: Callable[[], object], times: int) -> float:
    """Wall seconds of the fastest of several runs."""
    seconds = []
    for _ in range(times):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def measure() -> dict[str, object]:
    """All figures."""
    answers = people()
    yes = answers.yes
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        start = time.perf_counter()
        loop = by_scikit_learn(yes)
        loop_seconds = time.perf_counter() - start
    at_once = best(lambda: pairwise_kappa(yes), 20)
    difference = float(np.max(np.abs(pair_values(pairwise_kappa(yes)) - loop)))
    draws = Bootstrap(RESAMPLES)
    stimuli, raters = draws.weights("stimuli", STIMULI), draws.weights("people", PEOPLE)
    bootstraps = {
        "people": best(lambda: resampled_mean_kappa(yes, None, raters), 5),
        "stimuli": best(lambda: resampled_mean_kappa(yes, stimuli, None), 3),
        "both": best(lambda: resampled_mean_kappa(yes, stimuli, raters), 3),
    }
    return {
        "pairs": len(loop),
        "scikit_learn_seconds": loop_seconds,
        "physion_seconds": at_once,
        "times_faster": loop_seconds / at_once,
        "largest_difference": difference,
        "bootstrap_seconds": bootstraps,
        "eight_scenarios_seconds": best(everywhere(), 1),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"write {RESULTS.name}")
    write = parser.parse_args().write
    found = measure()
    bootstraps = found["bootstrap_seconds"]
    assert isinstance(bootstraps, dict)
    met = {
        "times_faster": found["times_faster"] >= TARGETS["times_faster"],  # type: ignore[operator]
        "largest_difference": found["largest_difference"] <= TARGETS["largest_difference"],  # type: ignore[operator]
        "bootstrap_seconds": max(bootstraps.values()) < TARGETS["bootstrap_seconds"],
    }
    report = {
        "date": datetime.now(UTC).date().isoformat(),
        "command": "OMP_NUM_THREADS=1 python benchmarks/analysis/agreement.py --write",
        "hardware": {
            "machine": processor(),
            "cores": os.cpu_count(),
            "threads": os.environ.get("OMP_NUM_THREADS", "not limited"),
            "load": os.getloadavg()[0],
        },
        "versions": {"python": platform.python_version(), "numpy": np.__version__,
                     "scikit-learn": sklearn.__version__},
        "people": PEOPLE, "stimuli": STIMULI, "models": MODELS, "resamples": RESAMPLES,
        **found, "targets": TARGETS, "met": met,
    }  # fmt: skip
    print(json.dumps(report, indent=2))
    if write:
        RESULTS.write_text(json.dumps(report, indent=2) + "\n")


if __name__ == "__main__":
    main()
