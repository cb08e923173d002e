"""How fast trials are made, what they take, and what that means for the whole study.

    python benchmarks/trials/generation.py [--count 4] [--write]

For each scenario, trials of the readout split (state, two movies, map) are chosen and made one by
one in this process, after everything is compiled: processor time a trial, frames a second and
bytes. Then a batch is made by two worker processes: how much of two cores is in use, and how much
memory a worker takes. Hours and gigabytes of all 25,200 trials follow from these.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from datetime import date
from pathlib import Path

import numpy as np

import physion
from physion.compute.tasks import processor
from physion.scenes.sampling.build import scenarios
from physion.trials.making.choose import choose
from physion.trials.making.make import make_trial
from physion.trials.making.plan import FULL_COUNTS, GenerateJob, GenerateSettings, plan_dataset
from physion.trials.trial_file import Trial

RESULTS = Path(__file__).parents[1] / "results"
CORES = (16, 64, 1000)
SPLITS = ("training", "readout", "testing")
PAIR_COUNT = 6
"""Trials a scenario that two workers make together."""


def measure(scenario: str, split: str, count: int, settings: GenerateSettings) -> dict[str, float]:
    """Means over ``count`` trials: processor seconds to choose and to make, frames, bytes."""
    folder = Path(tempfile.mkdtemp())
    rows = []
    try:
        for task in plan_dataset("benchmark", [scenario], {split: count}):
            begin = time.process_time()
            filled, _ = choose(GenerateJob(task, folder, settings))
            chosen = time.process_time()
            job = GenerateJob(filled, folder, settings)
            make_trial(job)
            made = time.process_time()
            frames = Trial.open(job.paths.trial_file).metadata.frames
            files = [path for path in folder.rglob("*") if path.is_file()]
            size = sum(path.stat().st_size for path in files)
            for path in files:
                path.unlink()
            rows.append((chosen - begin, made - chosen, frames, size))
    finally:
        shutil.rmtree(folder)
    choosing, making, frames, size = np.mean(rows, axis=0)
    return {
        "choose_s": float(choosing),
        "make_s": float(making),
        "frames": float(frames),
        "bytes": float(size),
        "frames_per_s": float(frames / (choosing + making)),
        "trials_per_s": float(1 / (choosing + making)),
    }


def two_workers(count: int) -> dict[str, float]:
    """A batch made by `physion generate` with two workers: cores in use, memory of a worker."""
    folder = Path(tempfile.mkdtemp())
    command = [sys.executable, "-m", "physion.cli.main", "generate", str(folder / "d")]
    command += ["--count", str(count), "--workers", "2", "--split", "readout"]
    try:
        started = time.perf_counter()
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        wall = time.perf_counter() - started
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    finally:
        shutil.rmtree(folder)
    spent = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return {
        "wall_s": wall,
        "cores_used": spent / wall,
        "largest_process_gb": after.ru_maxrss / 2**20,
        "trials": count * len(scenarios.names()),
    }


def whole_study(rows: dict[str, dict[str, dict[str, float]]]) -> dict[str, float]:
    """Processor hours and gigabytes of all trials of the study."""
    hours = size = 0.0
    for by_split in rows.values():
        for split in SPLITS:
            row, trials = by_split[split], FULL_COUNTS[split]
            hours += trials * (row["choose_s"] + row["make_s"]) / 3600
            size += trials * row["bytes"] / 1e9
    return {"core_hours": hours, "gigabytes": size}


def main() -> None:
    """Measure, print, and write if asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    settings = GenerateSettings()
    warm = GenerateSettings(jitters=1)
    rows: dict[str, dict[str, dict[str, float]]] = {}
    for name in scenarios.names():
        measure(name, "readout", 1, warm)  # compiled code is loaded here
        rows[name] = {split: measure(name, split, options.count, settings) for split in SPLITS}
        row = rows[name]["readout"]
        print(
            f"{name:9} {row['frames']:4.0f} frames  choose {row['choose_s']:5.2f} s  "
            f"make {row['make_s']:5.2f} s  {row['frames_per_s']:5.1f} frames/s a core  "
            f"{row['bytes'] / 1e6:.2f} MB",
            flush=True,
        )
    state = {
        "with robustness": measure("collide", "training", 20, GenerateSettings(movies=False)),
        "without": measure("collide", "training", 20, GenerateSettings(movies=False, jitters=0)),
    }
    for name, row in state.items():
        print(f"collide, state alone, {name}: {row['trials_per_s']:.1f} trials/s a core")
    pair = two_workers(PAIR_COUNT)
    study = whole_study(rows)
    print(
        f"two workers: {pair['cores_used']:.2f} cores in use over {pair['trials']} trials, "
        f"largest process {pair['largest_process_gb']:.2f} GB"
    )
    print(f"25,200 trials: {study['core_hours']:.0f} core hours, {study['gigabytes']:.0f} GB")
    for cores in CORES:
        print(f"  on {cores} cores: {study['core_hours'] / cores:.2g} hours")
    if options.write:
        found = {
            "date": date.today().isoformat(),
            "command": " ".join(["python", *sys.argv]),
            "machine": processor(),
            "cores": os.cpu_count(),
            "package": physion.__version__,
            "scenarios": rows,
            "state_alone": state,
            "two_workers": pair,
            "study": study,
        }
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / "generation.json").write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
