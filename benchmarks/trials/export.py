"""How fast official HDF5 files are made.

    python benchmarks/trials/export.py DATASET [--before SRC]

Every trial of a dataset is packed as an official file in memory, with pictures and without, in one
process and thread. Printed are frames and trials a second of processor time, and MB a trial; the
first trial is made once before, so that compilation is not counted. ``--before`` is the folder
``src`` of another version of the package, whose export is measured in turns with this one, each
version in processes of its own; a version that cannot leave pictures out is measured with them.

Make the dataset with ``physion generate DATASET --count 1 --width 256 --height 256``.
"""

from __future__ import annotations

import argparse
import inspect
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path

ROUNDS = 3
"""Measurements of each version; the median is printed."""


def measure(folder: Path, images: bool) -> dict[str, float]:
    """Return frames and trials per second of processor time, and MB per trial."""
    from physion.trials.dataset import Dataset
    from physion.trials.official.write_file import official_file

    if not images and "images" not in inspect.signature(official_file).parameters:
        return {}
    options = {} if images else {"images": False}
    dataset = Dataset(folder)
    names = dataset.trials()
    official_file(dataset.trial(names[0]), **options)
    frames = size = 0
    start = time.process_time()
    for name in names:
        trial = dataset.trial(name)
        size += len(official_file(trial, **options)[0])
        frames += trial.metadata.frames
    seconds = time.process_time() - start
    return {
        "frames/s": frames / seconds,
        "trials/s": len(names) / seconds,
        "MB/trial": size / len(names) / 1e6,
    }


def in_process(folder: Path, images: bool, source: Path) -> dict[str, float]:
    """Return what `measure` gives in a process of its own with the package in ``source``."""
    command = [sys.executable, __file__, str(folder), "--one", "images" if images else "state"]
    environment = {**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return dict(json.loads(done.stdout.splitlines()[-1]))


def main() -> None:
    """Measure and print one line for each version and kind of file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--before", type=Path, help="folder src of another version")
    parser.add_argument("--one", choices=("images", "state"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(options.dataset, options.one == "images")))
        return
    versions = {"here": Path(__file__).parents[2] / "src"}
    versions |= {"before": options.before} if options.before else {}
    for images in (True, False):
        found: dict[str, list[dict[str, float]]] = {name: [] for name in versions}
        for _ in range(ROUNDS):
            for name, source in versions.items():
                found[name].append(in_process(options.dataset, images, source))
        for name, runs in found.items():
            kind = "with pictures" if images else "without pictures"
            medians = {key: statistics.median(run[key] for run in runs) for key in runs[0]}
            text = ", ".join(f"{value:.2f} {key}" for key, value in medians.items())
            print(f"{name}, {kind}: {text or 'not possible'}", flush=True)


if __name__ == "__main__":
    main()
