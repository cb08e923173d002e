"""Readout of 1000 x 2.1 million features.

    python benchmarks/models/readout_at_size.py [--write]

The largest features of the study: 21 frames of 100,000 features each. 1000 fit trials and 100
tested ones lie in one file each, 9.2 GB in a temporary folder (``--folder`` chooses where), which
is removed afterwards. They are made one trial at a time. The readout has the full grid, 17 values
of C in 5 folds and the final fit, in a process of its own with one thread. Printed are its time
from the files to the probabilities, with the verification of all checksums, and the largest
resident memory of its process, libraries and mapped files included.

``--scale 0.1`` makes a tenth of the features. The run stops with an error if the readout needs
2 GB or more, or if the trials that it predicts are not predicted better than by guessing.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from physion.core.seeds import generator
from physion.readout.features import StoredFeatures, open_features, write_features
from physion.readout.logistic import fit_readout

RESULTS = Path(__file__).parents[1] / "results"
FIT, TEST, FRAMES, SIZE, FACTORS = 1000, 100, 21, 100_000, 20
BYTES = 2e9


def write_trials(folder: Path, size: int) -> None:
    """Write features (21, size) of all trials, which follow from 20 factors, and the outcomes."""
    rng = generator("readout at size")
    mixing = rng.normal(size=(FACTORS, size)).astype(np.float32)
    outcomes = []
    for trial in range(FIT + TEST):
        factors = rng.normal(size=(FRAMES, FACTORS)).astype(np.float32) * 0.3
        factors += rng.normal(size=FACTORS).astype(np.float32)
        features = factors @ mixing
        features += rng.standard_normal(features.shape, dtype=np.float32)
        path = folder / f"{trial}.safetensors"
        write_features(path, {"features": features})
        outcomes.append(float(factors[-1, :4].sum() + rng.normal()) > 0)
    np.save(folder / "outcomes.npy", np.array(outcomes))


def run_readout(folder: Path) -> dict[str, Any]:
    """Return time, memory and accuracy of the readout."""
    wall, cpu = time.perf_counter(), time.process_time()
    rows: list[Any] = [
        open_features(folder / f"{trial}.safetensors") for trial in range(FIT + TEST)
    ]
    features = StoredFeatures([str(trial) for trial in range(FIT + TEST)], rows)
    outcomes = np.load(folder / "outcomes.npy")
    train, test = features.select(range(FIT)), features.select(range(FIT, FIT + TEST))
    fitted = fit_readout(train, outcomes[:FIT], test)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return {
        "features": features.width,
        "wall_s": round(time.perf_counter() - wall, 1),
        "cpu_s": round(time.process_time() - cpu, 1),
        "peak_GB": round(peak / 1e9, 2),
        "c": fitted.c,
        "cv_accuracy": round(fitted.cv_accuracy, 3),
        "accuracy": round(float(np.mean((fitted.probability > 0.5) == outcomes[FIT:])), 3),
    }


def as_table(result: dict[str, Any]) -> str:
    """Return the figures as Markdown."""
    return (
        f"# Readout of {FIT} x {result['features']:,} features, full grid\n"
        f"`{result['command']}`, {result['date']}, {result['hardware']}, one thread, load average "
        f"{result['load_average']}.\n\n"
        "| wall s | CPU s | peak memory | size on disk | C | accuracy of 100 tested trials |\n"
        "|---|---|---|---|---|---|\n"
        f"| {result['wall_s']} | {result['cpu_s']} | {result['peak_GB']} GB | "
        f"{result['disk_GB']} GB | {result['c']:g} | {result['accuracy']} |\n"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scale", type=float, default=1.0, help="fraction of the features")
    parser.add_argument("--folder", help="where the temporary folder is made")
    parser.add_argument("--write", action="store_true", help="keep the result in results/")
    parser.add_argument("--part", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.part:
        print(json.dumps(run_readout(Path(arguments.part))))
        return
    size = int(SIZE * arguments.scale)
    needed = 4 * (FIT + TEST) * FRAMES * size
    with tempfile.TemporaryDirectory(dir=arguments.folder) as folder:
        free = shutil.disk_usage(folder).free
        if free < 1.1 * needed:
            sys.exit(
                f"{folder}: {needed / 1e9:.1f} GB are needed, {free / 1e9:.1f} are free; choose "
                "another --folder, or a --scale below 1"
            )
        write_trials(Path(folder), size)
        done = subprocess.run(
            [sys.executable, __file__, "--part", folder],
            env={**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
            stdout=subprocess.PIPE,
            check=True,
        )
    result = {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "hardware": "AMD EPYC, 2 cores",
        "python": platform.python_version(),
        "command": " ".join(["python", "benchmarks/models/readout_at_size.py", *sys.argv[1:]]),
        "load_average": round(os.getloadavg()[0], 1),
        "disk_GB": round(needed / 1e9, 2),
        **json.loads(done.stdout),
    }
    table = as_table(result)
    print(table)
    if arguments.write:
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / "readout_at_size.json").write_text(json.dumps(result, indent=2) + "\n")
        (RESULTS / "readout_at_size.md").write_text(table)
    assert result["peak_GB"] * 1e9 < BYTES, "the readout needs too much memory"
    assert result["accuracy"] > 0.6, "the readout predicts no better than guessing"


if __name__ == "__main__":
    main()
