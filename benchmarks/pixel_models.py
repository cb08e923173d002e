"""Speed of SVG and OP3, and whether they predict motion better than a copy of the last picture.

    OMP_NUM_THREADS=1 python benchmarks/pixel_models.py speed --write    # seconds a clip
    python benchmarks/pixel_models.py learn FOLDER --write               # error on moving pixels

``speed`` times a training step (forward and backward) and the features of a clip, with what is
imagined, on random pictures; times are processor time on a CPU.

``learn`` needs the trials of ``physion generate FOLDER --width 64 --height 64`` with the splits
training and testing. It trains the small models with three seeds and prints, for the testing
trials, the squared error of moving pixels of the imagined frames: after the training, before it,
and of repeating the last observed picture (`physion.models.vision.moving`).

With --write a section of ``results/pixel_models.md`` is replaced.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import os
import platform
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from physion import Dataset, build_model
from physion.models.batch import Batch
from physion.training.devices import Devices, make_fabric
from physion.training.losses import evaluating, mean_over
from physion.training.sources.open_source import whole_source
from physion.training.train import train_model
from physion.training.windows import ClipWindows, validation_requests

RESULTS = Path(__file__).parent / "results" / "pixel_models.md"
MODELS: tuple[tuple[str, dict[str, Any], int], ...] = (
    ("svg", {}, 8),
    ("svg", {"backbone": "vgg"}, 2),
    ("svg", {"size": "paper"}, 1),
    ("svg", {"size": "paper", "backbone": "dcgan"}, 1),
    ("op3", {}, 4),
    ("op3", {"size": "paper"}, 1),
)
"""Models whose speed is measured: name, options, clips of a batch."""

Rows = list[list[str]]


def noise_clips(clips: int, frames: int, size: int) -> Batch:
    """Return clips of random pictures, as tensors."""
    rng = np.random.default_rng(0)
    return Batch(
        tuple(f"clip_{row}" for row in range(clips)),
        np.tile(np.arange(frames), (clips, 1)),
        np.ones((clips, frames), np.bool_),
        rgb=rng.integers(0, 256, (clips, frames, size, size, 3), np.uint8),
    ).to("cpu")


def speed(repeats: int) -> Rows:
    """Return name, weights, frames and the least processor times of each model."""
    rows = []
    for name, options, clips in MODELS:
        model: Any = build_model(name, **options)
        spec = model.spec
        window = noise_clips(clips, model.window, spec.image_size)
        context = noise_clips(clips, spec.context, spec.image_size)

        def train(model: Any = model, window: Batch = window) -> None:
            model.train().loss(window)["loss"].backward()

        def extract(model: Any = model, context: Batch = context) -> None:
            model.eval().encode(context)
            model.imagine(context, 1, 0)

        weights = sum(value.numel() for value in model.parameters())
        times = [best_time(function, repeats) / clips for function in (train, extract)]
        cells = [model.name, f"{weights / 1e6:.2f} M", f"{spec.image_size} px", str(model.window)]
        rows.append([*cells, *(f"{seconds:.3f}" for seconds in times)])
        print(*rows[-1], flush=True)
    return rows


def best_time(function: Any, repeats: int) -> float:
    """Return the least processor time of several calls, seconds."""
    function()
    times = []
    for _ in range(repeats):
        start = time.process_time()
        function()
        times.append(time.process_time() - start)
    return min(times)


def learn(folder: Path, names: list[str], steps: int, seeds: int) -> Rows:
    """Return the errors of moving pixels of testing trials, by model and seed."""
    dataset, rows = Dataset(folder), []
    for name in names:
        for seed in range(seeds):
            model: Any = build_model(name, seed=seed)
            source = whole_source(dataset, model.spec)
            before = tested(model, source, dataset.trials("testing"))
            start = time.process_time()
            train_model(
                model,
                source,
                dataset.trials("training"),
                settings=dataclasses.replace(model.settings, steps=steps),
                seed=seed,
                name="all",
                folder=None,
                accelerator="cpu",
            )
            seconds = time.process_time() - start
            after = tested(model, source, dataset.trials("testing"))
            errors = (after["loss"], before["loss"], after["copy"])
            cells = [model.name, str(seed), *(f"{1000 * value:.2f}" for value in errors)]
            rows.append([*cells, f"{seconds:.0f}"])
            print(*rows[-1], flush=True)
    return rows


def tested(model: Any, source: Any, trials: list[str]) -> dict[str, float]:
    """Return the means of the model's errors and of the copy, one window of each trial."""
    windows = ClipWindows(source, tuple(trials), model.window)
    requests = validation_requests(windows, model.settings.batch, 0)
    fabric = make_fabric(Devices("cpu"), "32-true")

    def errors(batch: Batch) -> dict[str, torch.Tensor]:
        return {**model.loss(batch), "copy": model.baseline(batch)}

    with evaluating(model, fabric):
        return mean_over(errors, windows, requests, fabric, 0)


def table(head: list[str], rows: Rows) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def write_section(title: str, text: str) -> None:
    """Replace a section of the results, or append it."""
    known = RESULTS.read_text() if RESULTS.is_file() else "# SVG and OP3\n"
    known = re.sub(rf"\n## {re.escape(title)}\n.*?(?=\n## |\Z)", "", known, flags=re.DOTALL)
    where = f"{datetime.date.today()}, {platform.machine()}, torch {torch.__version__}"
    threads = f"{torch.get_num_threads()} thread(s), load {os.getloadavg()[0]:.1f}"
    RESULTS.write_text(f"{known.rstrip()}\n\n## {title}\n{text}\n\n{where}, {threads}.\n")


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=("speed", "learn"))
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--models", nargs="+", default=["svg", "op3"])
    parser.add_argument("--steps", type=int, default=1500)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    if options.part == "speed":
        head = ["model", "weights", "pictures", "frames", "training step, s", "features, s"]
        title, text = "Processor time of a clip", table(head, speed(options.repeats))
    else:
        if options.folder is None:
            parser.error("learn needs the folder of the trials")
        rows = learn(options.folder, options.models, options.steps, options.seeds)
        head = ["model", "seed", "trained", "untrained", "copy", "training, s"]
        title = "Squared error of moving pixels, times 1000"
        text = f"{options.steps} steps.\n\n" + table(head, rows)
    print(text)
    if options.write:
        write_section(title, text)


if __name__ == "__main__":
    main()
