"""A study with invented people and models on two scenarios, for the tests of reports."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from physion.report.compare import CompareResult, compare

SCENARIOS = ("collide", "drop")
STEMS = {"collide": "pilot_it2_collision_simple_box", "drop": "pilot_it2_drop_simple_box"}
PEOPLE, STIMULI = 8, 16


def responses() -> pd.DataFrame:
    """Return answers of eight people per scenario; the last of Collide says yes throughout."""
    generator = np.random.default_rng(2)
    rows = []
    for scenario in SCENARIOS:
        easy = generator.normal(1.0, 1.2, STIMULI)
        for person in range(PEOPLE):
            key = {"participant": f"{scenario}-{person}", "session": f"{scenario}-{person}",
                   "scenario": scenario, "simulated": False}  # fmt: skip
            for place in range(STIMULI):
                label = place % 2 == 0
                right = generator.random() < 1 / (1 + np.exp(-easy[place]))
                yes = True if (scenario, person) == ("collide", PEOPLE - 1) else label == right
                rows.append(key | {"stimulus": f"{STEMS[scenario]}_{place:04d}", "phase": "test",
                                   "trial": place, "response": "yes" if yes else "no",
                                   "label": label,
                                   "rt_ms": 500 + 900 * generator.random()})  # fmt: skip
    return pd.DataFrame(rows)


def predictions() -> pd.DataFrame:
    """Return random answers of two models, one of them with two readouts, by official headers."""
    generator = np.random.default_rng(2)
    tables = []
    for model, readout in (("one", "observed"), ("one", "full"), ("two", "observed")):
        for scenario in SCENARIOS:
            p = generator.random(STIMULI)
            tables.append(pd.DataFrame({
                "Model": model, "Readout Type": readout, "Predicted Prob_true": p,
                "Predicted Outcome": p > 0.5, "Actual Outcome": np.arange(STIMULI) % 2 == 0,
                "Stimulus Name": [f"{STEMS[scenario]}_{i:04d}" for i in range(STIMULI)],
            }))  # fmt: skip
    return pd.concat(tables)


def compare_small(
    folder: Path, answers: pd.DataFrame | None = None, **options: object
) -> CompareResult:
    """Return the comparison of the models with the people, by way of files in ``folder``."""
    (responses() if answers is None else answers).to_csv(folder / "responses.csv", index=False)
    predictions().to_csv(folder / "predictions.csv", index=False)
    return compare(
        folder / "predictions.csv", responses=folder / "responses.csv", resamples=60,
        **options,  # type: ignore[arg-type]
    )  # fmt: skip
