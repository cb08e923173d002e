"""Accuracies of all small models on own trials, with the anchors, as one table.

    OMP_NUM_THREADS=1 python benchmarks/models/small_table.py FOLDER --write

Makes 200 training, 200 readout and 60 tested trials a scenario in FOLDER, with movies of 64 px, and
evaluates on them under the protocol *all*

- models whose weights come with the package;
- EfficientNet-Lite0 of ImageNet, whose dynamics are trained here, and fine-tuned for 200 steps;
- the same networks with random weights, untrained;
- anchors.

The same command continues a run that was interrupted, and does nothing again. The processor time of
every part is kept in FOLDER and printed with the table. With --write it is written to
``results/small.txt``.
"""

from __future__ import annotations

import argparse
import datetime
import json
import resource
import subprocess
import sys
from pathlib import Path

import pandas as pd
import torch

from physion.cli.text_table import text_table
from physion.compute.machine import processor

RESULTS = Path(__file__).parents[1] / "results" / "small.txt"
COUNTS = {"training": 200, "readout": 200, "testing": 60}
SIZE = ["--width", "64", "--height", "64", "--jitters", "0"]
VISION = "svg,op3,cswm,rpin"
FROZEN = "pEffNetLite0-mlp,pEffNetLite0-lstm"
ANCHORS = (
    "state-classifier,constant-motion,already-touched,blob-centroids,copy-last-frame,outcome,chance"
)
PARTS: dict[str, tuple[str, ...]] = {
    "shipped weights": (f"{VISION},dpi,gns,gns-ransac", "--weights", "shipped"),
    "anchors": (ANCHORS,),
    "frozen encoders": (FROZEN,),
    "untrained": (f"{VISION},{FROZEN}", "--weights", "random", "--untrained"),
    "fine-tuned encoders": (FROZEN, "--option", "fine_tuned=true", "--steps", "200"),
}
"""Models and options of `physion evaluate` by part of the table."""


def run(folder: Path, part: str, *words: str) -> str:
    """Run a verb and return what it printed; add its processor time to those of the part."""
    path = folder / "seconds.json"
    seconds = json.loads(path.read_text()) if path.is_file() else {}
    before = processor_seconds()
    done = subprocess.run(
        [sys.executable, "-m", "physion.cli.main", *words], stdout=subprocess.PIPE, text=True
    )
    seconds[part] = seconds.get(part, 0.0) + processor_seconds() - before
    path.write_text(json.dumps(seconds))
    if done.returncode:
        raise SystemExit(f"physion {' '.join(words)} ended with code {done.returncode}")
    return done.stdout


def processor_seconds() -> float:
    """Return the processor time of all programs that were run so far, seconds."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def make_table(folder: Path) -> pd.DataFrame:
    """Make trials, evaluate all parts, and return their accuracies."""
    folder.mkdir(parents=True, exist_ok=True)
    movies = str(folder / "movies")
    for split, count in COUNTS.items():
        chosen = ["--split", split, "--count", str(count)]
        run(folder, "trials", "generate", movies, "--name", "small", *chosen, *SIZE)
    tables = []
    for part, (models, *options) in PARTS.items():
        out = ["--out", str(folder / "models"), "--json"]
        printed = run(folder, part, "evaluate", movies, models, *options, *out)
        tables.append(pd.read_csv(json.loads(printed)["results"]))
    # pandas reads the name "none" of no weights as text, and an empty protocol as NaN.
    return pd.concat(tables, ignore_index=True).fillna({"init": "none", "protocol": ""})


def main() -> None:
    """Print the table, and write it on request."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    table = text_table(make_table(options.folder))
    seconds = json.loads((options.folder / "seconds.json").read_text())
    total = sum(seconds.values()) / 60
    text = [
        "Accuracies of small models on own trials, 200 of the readout and 60 tested a scenario:",
        "  OMP_NUM_THREADS=1 python benchmarks/models/small_table.py FOLDER --write",
        f"{datetime.date.today()}, {processor()}, torch {torch.__version__}.",
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
