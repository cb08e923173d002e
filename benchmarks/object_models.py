"""Speed of C-SWM and RPIN, and what they have learned of movies that they were not trained on.

    OMP_NUM_THREADS=1 python benchmarks/object_models.py speed --write    # seconds a clip
    python benchmarks/object_models.py learn FOLDER --write               # ranks, errors of boxes

``speed`` times a training step (forward and backward) and the features of a clip, with what is
imagined, on random pictures with moving boxes; times are processor time on a CPU.

``learn`` needs the trials of ``physion generate FOLDER --width 64 --height 64`` with the splits
training and testing. It trains the small models with three seeds and prints, for one clip of every
testing trial, before and after the training and for the trivial predictor:

- C-SWM: the mean reciprocal rank of the true next state among 100 states, five of each of 20 clips;
  the trivial predictor copies the present state.
- RPIN: the mean distance of predicted from true centres of boxes, as part of the picture's side,
  times 1000; the trivial predictor keeps the last velocity.

With --write a section of ``results/object_models.md`` is replaced.
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
from torch import Tensor

from physion import Dataset, build_model
from physion.models.batch import Batch, Spec
from physion.models.cswm.contrast import ranking
from physion.seeds import generator
from physion.training.sources.open_source import whole_source
from physion.training.train import train_model
from pixel_models import best_time, table

RESULTS = Path(__file__).parent / "results" / "object_models.md"
MODELS = (("cswm", "small", 8), ("cswm", "paper", 1), ("rpin", "small", 4), ("rpin", "paper", 1))
"""Models whose speed is measured: name, size, clips of a batch."""
RANKED_CLIPS = 20
"""Clips whose states are ranked together: with five states each, 100."""
LATEST_START = 40
"""Last frame at which a tested clip starts; later most objects rest."""

Rows = list[list[str]]


def moving_clips(clips: int, frames: int, spec: Spec) -> Batch:
    """Return clips of random pictures in which the boxes of all objects move, as tensors."""
    rng = np.random.default_rng(0)
    shape = (clips, frames, spec.image_size, spec.image_size, 3)
    ends = rng.uniform(0.2, 0.8, (2, clips, 1, spec.objects, 2))
    part = np.linspace(0, 1, frames)[None, :, None, None]
    centers = ends[0] + part * (ends[1] - ends[0])
    boxes = np.concatenate([centers - 0.1, centers + 0.1], -1).astype(np.float32)
    return Batch(
        tuple(f"clip_{row}" for row in range(clips)),
        np.tile(np.arange(frames), (clips, 1)),
        np.ones((clips, frames), np.bool_),
        rgb=rng.integers(0, 256, shape, np.uint8),
        boxes=boxes if "boxes" in spec.inputs else None,
    ).to("cpu")


def speed(repeats: int) -> Rows:
    """Return name, weights, pictures, frames and the least processor times of each model."""
    rows = []
    for name, size, clips in MODELS:
        model: Any = build_model(name, size=size)
        spec = model.spec
        window = moving_clips(clips, model.window, spec)
        context = moving_clips(clips, spec.context, spec)

        def train(model: Any = model, window: Batch = window) -> None:
            model.train().loss(window)["loss"].backward()

        def extract(model: Any = model, context: Batch = context) -> None:
            with torch.inference_mode():
                model.eval().encode(context)
                model.imagine(context, 1, 0)

        weights = sum(value.numel() for value in model.parameters())
        times = [best_time(function, repeats) / clips for function in (train, extract)]
        cells = [model.name, f"{weights / 1e6:.2f} M", f"{spec.image_size} px", str(model.window)]
        rows.append([*cells, *(f"{seconds:.4f}" for seconds in times)])
        print(*rows[-1], flush=True)
    return rows


def learn(folder: Path, names: list[str], steps: int, seeds: int) -> Rows:
    """Return the metrics of testing trials by model and seed."""
    dataset, rows = Dataset(folder), []
    for name in names:
        for seed in range(seeds):
            model: Any = build_model(name, seed=seed)
            source = whole_source(dataset, model.spec)
            clips = tested_clips(model, source, dataset.trials("testing"))
            before, _ = metrics(name, model, clips)
            start = time.process_time()
            train_model(
                model,
                source,
                dataset.trials("training"),
                settings=dataclasses.replace(model.settings, steps=steps or model.settings.steps),
                seed=seed,
                name="all",
                folder=None,
                accelerator="cpu",
            )
            seconds = time.process_time() - start
            after, trivial = metrics(name, model, clips)
            values = [f"{value:.3f}" for value in (after, before, trivial)]
            rows.append([model.name, str(seed), *values, f"{seconds:.0f}"])
            print(*rows[-1], flush=True)
    return rows


def tested_clips(model: Any, source: Any, trials: list[str]) -> list[Batch]:
    """Return one training clip of every trial, from an early frame, in batches."""
    rng = generator("tested clips")
    starts = rng.integers(LATEST_START + 1, size=len(trials)).tolist()
    groups = range(0, len(trials) - RANKED_CLIPS + 1, RANKED_CLIPS)
    if not groups:
        raise SystemExit(f"learn needs {RANKED_CLIPS} testing trials or more")
    chosen = [slice(start, start + RANKED_CLIPS) for start in groups]
    return [source.window(trials[part], starts[part], model.window).to("cpu") for part in chosen]


@torch.no_grad()
def metrics(name: str, model: Any, clips: list[Batch]) -> tuple[float, float]:
    """Return the metric of a model and of the trivial predictor, means over the batches."""
    model.eval()
    pairs: list[tuple[float, float]] = []
    for batch in clips:
        if name == "cswm":
            ranks, copied = model.next_state_ranks(batch)
            pairs.append((ranking(ranks).reciprocal, ranking(copied).reciprocal))
        else:
            errors: tuple[Tensor, Tensor] = model.center_errors(batch)
            own, constant = (1000 * float(value.nanmean()) for value in errors)
            pairs.append((own, constant))
    own, trivial = np.mean(pairs, axis=0)
    return float(own), float(trivial)


def write_section(title: str, text: str) -> None:
    """Replace a section of the results, or append it."""
    known = RESULTS.read_text() if RESULTS.is_file() else "# C-SWM and RPIN\n"
    known = re.sub(rf"\n## {re.escape(title)}\n.*?(?=\n## |\Z)", "", known, flags=re.DOTALL)
    where = f"{datetime.date.today()}, {platform.machine()}, torch {torch.__version__}"
    threads = f"{torch.get_num_threads()} thread(s), load {os.getloadavg()[0]:.1f}"
    RESULTS.write_text(f"{known.rstrip()}\n\n## {title}\n{text}\n\n{where}, {threads}.\n")


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=("speed", "learn"))
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument("--models", nargs="+", default=["cswm", "rpin"], choices=("cswm", "rpin"))
    parser.add_argument("--steps", type=int, default=0, help="0: those of the model")
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
        head = ["model", "seed", "trained", "untrained", "trivial", "training, s"]
        title, text = "Rank of the next state, and distance of boxes", table(head, rows)
    print(text)
    if options.write:
        write_section(title, text)


if __name__ == "__main__":
    main()
