"""How fast trials are made, what they take, and what that means for the whole study.

    python benchmarks/trials/generation.py [--count 4] [--write]
    python benchmarks/trials/generation.py [--count 4] --profile

For each scenario, trials of the readout split (state, two movies, map) are chosen and made one by
one in this process, after everything is compiled: processor time a trial, frames a second and
bytes. Then a batch is made by two worker processes: how much of two cores is in use, and how much
memory a worker takes. Hours and gigabytes of all 25,200 trials follow from these.

``--profile`` prints instead where the processor time of a readout trial goes, as a Markdown table:
the eight simulations that measure robustness, judging of candidates for its scene (a simulation and
a picture each), its own simulation, pictures, encoding of both movies, map, trial file, and what is
left.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import ExitStack
from datetime import date
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest import mock

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


PARTS: dict[str, tuple[str, ...]] = {
    "repeats": ("physion.trials.making.choose:robustness",),
    "candidates": ("physion.trials.making.choose:judge",),
    "own simulation": ("physion.trials.making.make:motion_of",),
    "pictures": tuple(f"physion.rendering.renderer:Renderer.{n}" for n in ("__init__", "render")),
    "encoding": tuple(f"physion.trials.video:MovieEncoder.{n}" for n in ("add", "finish")),
    "map": ("physion.trials.making.make:encode_png",),
    "trial file": ("physion.trials.trial_file:TrialWriter.__init__",
                   "physion.trials.trial_file:TrialWriter.finish"),
    "disk": ("physion.trials.making.make:write_files",),
}  # fmt: skip
"""Parts of making a trial, and the functions whose time they are; inner parts are not counted in
outer ones."""


def profile(scenario: str, count: int) -> dict[str, float]:
    """Mean seconds of processor time of each part of a readout trial."""
    spent, running = dict.fromkeys(PARTS, 0.0), []

    def timed(part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        @functools.wraps(function)
        def run(*arguments: Any, **options: Any) -> Any:
            running.append(0.0)
            begin = time.process_time()
            try:
                return function(*arguments, **options)
            finally:
                whole = time.process_time() - begin
                spent[part] += whole - running.pop()
                if running:
                    running[-1] += whole

        return run

    with ExitStack() as stack:
        for part, names in PARTS.items():
            for name in names:
                module, _, path = name.partition(":")
                *owners, last = path.split(".")
                owner = functools.reduce(getattr, owners, import_module(module))
                stack.enter_context(
                    mock.patch.object(owner, last, timed(part, getattr(owner, last)))
                )
        row = measure(scenario, "readout", count, GenerateSettings())
    spent = {part: seconds / count for part, seconds in spent.items()}
    whole = row["choose_s"] + row["make_s"]
    return {**spent, "rest": whole - sum(spent.values()), "all": whole}


def print_profile(count: int) -> None:
    """Print `profile` of all scenarios."""
    columns = (*PARTS, "rest", "all")
    print(f"| scenario | {' | '.join(columns)} |\n|---{'|---' * len(columns)}|")
    for name in scenarios.names():
        measure(name, "readout", 1, GenerateSettings(jitters=1))
        row = profile(name, count)
        cells = [f"{row[c] / row['all']:.2f}" for c in columns[:-1]] + [f"{row['all']:.2f} s"]
        print(f"| {name} | {' | '.join(cells)} |", flush=True)


def main() -> None:
    """Measure, print, and write if asked to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--profile", action="store_true")
    options = parser.parse_args()
    if options.profile:
        print_profile(options.count)
        return
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
