"""Accuracies of all small models on own trials, with the baselines, as one table.

    OMP_NUM_THREADS=1 python benchmarks/models/small_table.py FOLDER --write

Makes 200 training, 200 readout and 60 tested trials a scenario in FOLDER, with movies of 64 px, and
evaluates on them under the protocol *all*

- vision models whose weights come with the package;
- particle models whose weights come with the package, on the same tested trials without movies:
  they have no readout;
- EfficientNet-Lite0 of ImageNet, whose dynamics are trained here, and fine-tuned for 200 steps;
- baselines.

The same command continues a run that was interrupted, and does nothing again. The processor time of
every part, also that of interrupted runs, is kept in FOLDER and printed with the table. With
--write it is written to ``results/small.txt``.
"""

from __future__ import annotations

import argparse
import datetime
import json
import resource
import shlex
import subprocess
import sys
from pathlib import Path

import pandas as pd
import torch

from physion.cli.output import text_table
from physion.compute.tasks import processor
from physion.core.files import write_atomic

RESULTS = Path(__file__).parents[1] / "results" / "small.txt"
COUNTS = {"training": 200, "readout": 200, "testing": 60}
SIZE = ["--width", "64", "--height", "64", "--jitters", "0"]
VISION = "svg,op3,cswm,rpin"
FROZEN = "pEffNetLite0-mlp,pEffNetLite0-lstm"
BASELINES = (
    "state-trees,constant-motion,already-touched,blob-centroids,copy-last-frame,outcome,chance"
)
MOVIES, STATES = "movies", "states"
"""Folders of the trials."""
PARTS: dict[str, tuple[str, ...]] = {
    "vision models": (VISION, MOVIES),
    "particle models": ("dpi,gns,gns-ransac", STATES),
    "baselines": (BASELINES, MOVIES),
    "frozen encoders": (FROZEN, MOVIES),
    "fine-tuned encoders": (FROZEN, MOVIES, "--option", "fine_tuned=true", "steps=200"),
}
"""Models, trials and options of `physion evaluate` by part of the table."""


def run(folder: Path, part: str, *arguments: str) -> str:
    """Run a verb in a folder and return what it printed; add up the processor time of the part."""
    path = folder / "seconds.json"
    seconds = json.loads(path.read_text()) if path.is_file() else {}
    before = processor_seconds()
    command = [sys.executable, "-m", "physion.cli.main", *arguments]
    try:
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True, cwd=folder)
    finally:
        seconds[part] = seconds.get(part, 0.0) + processor_seconds() - before
        write_atomic(path, json.dumps(seconds).encode())
    if done.returncode:
        raise SystemExit(f"physion {' '.join(arguments)} ended with code {done.returncode}")
    return done.stdout


def processor_seconds() -> float:
    """Return the processor time of all programs that were run so far, seconds."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def make_table(folder: Path, parts: dict[str, tuple[str, ...]]) -> pd.DataFrame:
    """Make trials, evaluate the parts, and return their accuracies."""
    folder.mkdir(parents=True, exist_ok=True)
    for arguments in generations():
        run(folder, "trials", *arguments)
    tables = []
    for part, options in parts.items():
        printed = run(folder, part, "evaluate", *options, "--out", "models", "--json")
        tables.append(pd.DataFrame(json.loads(printed)["scores"]))
    return pd.concat(tables, ignore_index=True)


def generations() -> list[list[str]]:
    """Return the arguments of `physion generate` for all trials."""
    chosen = [
        [folder, "--split", split, "--count", str(COUNTS[split]), *more]
        for folder, split, *more in (
            *((MOVIES, split) for split in COUNTS),
            (STATES, "testing", "--no-movies"),
        )
    ]
    return [["generate", *options, "--name", "small", *SIZE] for options in chosen]


def main() -> None:
    """Print the table, and write it on request."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--without", nargs="+", default=(), choices=PARTS, help="parts left out")
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    parts = {part: evaluated for part, evaluated in PARTS.items() if part not in options.without}
    table = text_table(make_table(options.folder, parts))
    used = json.loads((options.folder / "seconds.json").read_text())
    seconds = {part: used[part] for part in ("trials", *parts)}
    total = sum(seconds.values()) / 60
    left_out = f" --without {shlex.join(options.without)}" if options.without else ""
    text = [
        "Accuracies of small models on own trials, 200 of the readout and 60 tested a scenario:",
        f"  OMP_NUM_THREADS=1 python benchmarks/models/small_table.py FOLDER --write{left_out}",
        f"{datetime.date.today()}, {processor()}, torch {torch.__version__}. It runs:",
        *(f"  physion {' '.join(arguments)}" for arguments in generations()),
        *(f"  physion evaluate {' '.join(evaluated)}" for evaluated in parts.values()),
        f"Processor time without the training of shipped weights: {total:.0f} minutes, of which",
        *(f"  {part}: {value / 60:.1f}" for part, value in seconds.items()),
        "",
        table,
    ]
    print("\n".join(text))
    if options.write:
        RESULTS.write_text("\n".join(text) + "\n")


if __name__ == "__main__":
    main()
