"""How long a whole comparison takes.

    python benchmarks/analysis/comparison.py [--write] [--keep FOLDER]

Simulated: 20 models (5 by 4 settings of readout and training), 8 scenarios of 150 stimuli and 100
people each, who answer all of them once and 10 practice trials. Timed, from files to the finished
page: reading and checking, flags, every analysis of people and models with 1000 resamples, tests of
all pairs of models, and every figure as SVG and PNG. The parts are timed in the same run. The aim
is under 60 s.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from physion.analysis import compare as results
from physion.core.names import SCENARIOS
from physion.report import build, people
from physion.report.compare import compare

RESULTS = Path(__file__).parents[1] / "results"
PEOPLE, STIMULI, PRACTICE = 100, 150, 10
MODELS = ("guesser", "edges", "frozen", "objects", "simulation")
SETTINGS = (
    ("C", "all"),
    ("B", "all"),
    ("A", "all"),
    ("B", "same"),
)
"""Readout and training of each model's four variants."""


def stimulus(scenario: str, place: int) -> str:
    return f"{scenario}_{place:04d}"


def easiness(rng: np.random.Generator) -> np.ndarray:
    """Log odds of being right, by scenario and stimulus: most are easy, some fool people."""
    return rng.normal(1.2, 1.3, (len(SCENARIOS), STIMULI))


def responses(easy: np.ndarray, rng: np.random.Generator) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Trials and sessions with the columns of the experiment's export."""
    trials, sessions = [], []
    for at, scenario in enumerate(SCENARIOS):
        for person in range(PEOPLE):
            name = f"{scenario}-{person:03d}"
            keys = {"participant": name, "session": name, "scenario": scenario, "simulated": False,
                    "buttons": ("yes-no", "no-yes")[person % 2]}  # fmt: skip
            sessions.append(keys | {"age": int(rng.integers(18, 70)),
                                    "gender": ("woman", "man")[person % 2],
                                    "difficulty": int(rng.integers(1, 6))})  # fmt: skip
            order = rng.permutation(STIMULI)
            p = 1 / (1 + np.exp(-(easy[at, order] + rng.normal(0, 0.35))))
            label, right = order % 2 == 0, rng.random(STIMULI) < p
            log_rt = 6.6 + 0.4 * (1 - p) + rng.normal(0, 0.2) + rng.normal(0, 0.35, STIMULI)
            names = [stimulus(scenario, place) for place in order]
            trials.append(_trials(keys, names, "test", label == right, label, np.exp(log_rt)))
            label = np.arange(PRACTICE) % 2 == 0
            right = rng.random(PRACTICE) < 0.85
            names = [f"{scenario}_practice_{place}" for place in range(PRACTICE)]
            rt = np.full(PRACTICE, 900.0)
            trials.append(_trials(keys, names, "familiarization", label == right, label, rt))
    return pd.concat(trials, ignore_index=True), pd.DataFrame(sessions)


def _trials(
    keys: dict[str, Any],
    names: list[str],
    phase: str,
    yes: np.ndarray,
    label: np.ndarray,
    rt: np.ndarray,
) -> pd.DataFrame:
    response = np.where(yes, "yes", "no")
    table = pd.DataFrame({"stimulus": names, "phase": phase, "trial": np.arange(len(names)),
                          "response": response, "label": label, "rt_ms": rt.round(1)})  # fmt: skip
    return table.assign(**keys)


def predictions(easy: np.ndarray, rng: np.random.Generator) -> pd.DataFrame:
    """What the models say: a blend of the outcome, of people's inclination, and of noise."""
    tables = []
    for skill, model in enumerate(MODELS):
        for readout, training in SETTINGS:
            more = 0.5 if readout == "A" else 0.2 if training == "same" else 0.0
            for at, scenario in enumerate(SCENARIOS):
                truth = np.arange(STIMULI) % 2 == 0
                lean = np.where(truth, 1, -1) * (0.35 * skill * easy[at] / 2 + 0.3 * skill + more)
                p = 1 / (1 + np.exp(-(lean + rng.normal(0, 1.0, STIMULI))))
                tables.append(
                    pd.DataFrame(
                        {
                            "Model": model,
                            "Readout Type": readout,
                            "Readout Test Data": scenario,
                            "Predicted Prob_true": p.round(6),
                            "Predicted Outcome": p > 0.5,
                            "Actual Outcome": truth,
                            "Stimulus Name": [stimulus(scenario, i) for i in range(STIMULI)],
                            "Dynamics Training Dataset": scenario if training == "same" else "all",
                        }
                    )
                )
    return pd.concat(tables, ignore_index=True)


def write_study(folder: Path, seed: int = 0) -> tuple[Path, Path, Path]:
    """Files of predictions, responses and sessions, made of ``seed``."""
    rng = np.random.default_rng(seed)
    easy = easiness(rng)
    trials, sessions = responses(easy, rng)
    tables = {"predictions": predictions(easy, rng), "responses": trials, "sessions": sessions}
    paths = []
    for name, table in tables.items():
        paths.append(folder / f"{name}.csv")
        table.to_csv(paths[-1], index=False)
    return paths[0], paths[1], paths[2]


PARTS: tuple[tuple[Any, str], ...] = (
    (people, "read_any_responses"),
    (people, "analyse_people"),
    (results, "compare_everywhere"),
    (results, "compare_scores"),
    (results, "paired_tests"),
    (results, "fits_of_people"),
    (results, "fits_of_models"),
    (build, "write_plot"),
    (build, "render_page"),
)
"""The functions whose time is taken."""


def timed(module: Any, name: str, spent: dict[str, float]) -> None:
    """Replaces a function by one that adds its time to ``spent``; for figures one by one, too."""
    function: Callable[..., Any] = getattr(module, name)

    def wrapped(*arguments: Any, **options: Any) -> Any:
        start = time.perf_counter()
        found = function(*arguments, **options)
        seconds = time.perf_counter() - start
        spent[name] += seconds
        if name == "write_plot":
            spent[f"figure {arguments[0].name}"] += seconds
        return found

    setattr(module, name, wrapped)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="keep the result in results/")
    parser.add_argument("--keep", type=Path, help="folder in which report and files stay")
    arguments = parser.parse_args()
    spent: dict[str, float] = defaultdict(float)
    for module, name in PARTS:
        timed(module, name, spent)
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.keep or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        predicted, answered, sessions = write_study(folder)
        start, cpu = time.perf_counter(), time.process_time()
        result = compare(predicted, responses=answered, sessions=sessions)
        page = result.report(folder / "report")
        wall, cpu = time.perf_counter() - start, time.process_time() - cpu
        size = page.stat().st_size
    result = {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "hardware": "AMD EPYC, 2 cores",
        "python": platform.python_version(),
        "command": "python benchmarks/analysis/comparison.py --write",
        "models": len(MODELS) * len(SETTINGS),
        "answers": len(SCENARIOS) * PEOPLE * STIMULI,
        "load_average": round(os.getloadavg()[0], 1),
        "wall_s": round(wall, 1),
        "cpu_s": round(cpu, 1),
        "aim_s": 60,
        "parts_wall_s": {name: round(seconds, 2) for name, seconds in sorted(spent.items())},
        "page_bytes": size,
    }
    text = json.dumps(result, indent=2)
    print(text)
    if arguments.write:
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / "comparison.json").write_text(text + "\n")


if __name__ == "__main__":
    main()
