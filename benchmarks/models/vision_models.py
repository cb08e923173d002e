"""Speed of the vision models, and what they have learned of movies that they were not trained on.

    OMP_NUM_THREADS=1 python benchmarks/models/vision_models.py speed --write  # seconds a clip
    OMP_NUM_THREADS=1 python benchmarks/models/vision_models.py longest --write  # memory of *full*
    OMP_NUM_THREADS=1 python benchmarks/models/vision_models.py answers --write  # of intuition
    python benchmarks/models/vision_models.py learn FOLDER --write  # after trainings
    python benchmarks/models/vision_models.py shipped FOLDER --write  # shipped weights

``speed`` times a training step (forward and backward) and the features of a clip, with what is
imagined, on random pictures with moving boxes; of frozen encoders, which have random weights here,
it times a training step of the dynamics on stored features. Times are processor time on a CPU, and
elapsed time on a GPU (``--accelerator cuda``, also with ``--precision bf16-mixed``), where batches
are 16 times as large.

``longest`` encodes random pictures, as many as *full* reads of the longest movies, 602 frames, each
model in a process of its own, and prints the memory of that process before and at most.

``answers`` times predictions of the models of intuition from such masks and pictures in memory.

``learn`` needs the trials of ``physion generate FOLDER --width 64 --height 64`` with the splits
training and testing. It trains the small models with three seeds and prints, for one clip of every
testing trial, after and before the training and for trivial predictors, and the ratio of the
trained to the best trivial one, which is to be above 1 for C-SWM and below 1 for the others:

- C-SWM: the mean reciprocal rank of the true next state among all states of 20 clips; the trivial
  predictor copies the present state.
- RPIN: the mean distance of predicted from true centres of boxes, as part of the picture's side,
  times 1000; the trivial predictor keeps the last velocity. Untrained, RPIN predicts that boxes
  stay.
- SVG and OP3: the squared error of moving pixels of the imagined frames, times 1000
  (`physion.models.vision`); one trivial predictor repeats the last observed picture, another
  shows an empty scene, the median of the observed pictures. A model that only lets moving objects
  vanish is better than the first one; it must be better than both.
- Dynamics of the frozen EfficientNet-Lite0: the squared error of the next feature, times 1000; the
  trivial predictor repeats the last one, and so do untrained dynamics.

``shipped`` prints the same for the weights that come with the package, without training.

With --write a section of ``results/vision_models.md`` is replaced; ``learn`` has one for every
choice of models.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import itertools
import os
import re
import resource
import tempfile
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from physion import Dataset, build_model
from physion.clips.batch import Batch, Spec
from physion.clips.clips import whole_source
from physion.compute.tasks import processor
from physion.core.seeds import generator, stable_hash
from physion.core.tables import markdown_table
from physion.models.build import build_untrained
from physion.models.cswm import ranking
from physion.models.vision import empty_scene_error
from physion.readout.features import FeatureStore, encode_clips
from physion.training.train import train_model

RESULTS = Path(__file__).parents[1] / "results" / "vision_models.md"
METRICS = {
    "cswm": "mean reciprocal rank of the next state",
    "rpin": "distance of centres",
    "svg": "error of moving pixels",
    "op3": "error of moving pixels",
    "pEffNetLite0-mlp": "error of the next feature",
    "pEffNetLite0-lstm": "error of the next feature",
}
"""What is measured of each model."""
SHIPPED = ("cswm", "rpin", "svg", "op3")
"""Models whose weights come with the package."""
DYNAMICS = tuple(name for name in METRICS if name not in SHIPPED)
"""Models of which the dynamics are trained alone."""
ENCODERS = ("pVGG-mlp", "pDeIT-mlp", "pEffNetLite0-mlp")
"""Frozen encoders whose speed is measured, with a training step of the dynamics."""
INTUITION = ("intuition-masks", "intuition-pixels")
"""Models whose predictions are timed."""
ANSWERED = 50
"""Clips that are predicted together."""
SIZES = ("small", "paper")
MODELS: tuple[tuple[str, dict[str, Any], int], ...] = (
    ("cswm", {}, 8),
    ("cswm", {"size": "paper"}, 1),
    ("rpin", {}, 4),
    ("rpin", {"size": "paper"}, 1),
    ("svg", {}, 8),
    ("svg", {"backbone": "vgg"}, 2),
    ("svg", {"size": "paper"}, 1),
    ("svg", {"size": "paper", "backbone": "dcgan"}, 1),
    ("op3", {}, 4),
    ("op3", {"size": "paper"}, 1),
    *((name, {"size": size, "weights": "random"}, 1) for name in ENCODERS for size in SIZES),
)
"""Models whose speed is measured: name, options, clips of a batch."""
LONGEST = 602
"""Frames of the longest movies, of Support."""
FUTURE = 18
"""Steps that are imagined when speed is measured."""
TESTED_CLIPS = 20
"""Clips of a batch of testing trials, whose states are ranked together."""
LATEST_START = 40
"""Last frame at which a tested clip starts; later most objects rest."""

Rows = Iterator[list[str]]


def random_clips(clips: int, frames: int, spec: Spec) -> Batch:
    """Return clips of random pictures in which the boxes of all objects move, as tensors."""
    rng = generator("clips of random pictures")
    shape = (clips, frames, spec.image_size, spec.image_size, 3)
    ends = rng.uniform(0.2, 0.8, (2, clips, 1, spec.objects, 2))
    part = np.linspace(0, 1, frames)[None, :, None, None]
    centers = ends[0] + part * (ends[1] - ends[0])
    boxes = np.concatenate([centers - 0.1, centers + 0.1], -1).astype(np.float32)
    return Batch(
        tuple(f"clip_{row}" for row in range(clips)),
        np.tile(np.arange(frames), (clips, 1)),
        np.ones((clips, frames), np.bool_),
        future=FUTURE,
        rgb=rng.integers(0, 256, shape, np.uint8),
        ids=drawn_ids(boxes, spec.image_size) if "ids" in spec.inputs else None,
        boxes=boxes if "boxes" in spec.inputs else None,
    ).to("cpu")


def drawn_ids(boxes: NDArray[np.float32], size: int) -> NDArray[np.uint8]:
    """Return ids of pixels (B, T, size, size) of boxes (B, T, K, 4); later ones cover earlier."""
    side = (np.arange(size) + 0.5) / size
    inside = (side > boxes[..., :2, None]) & (side < boxes[..., 2:, None])
    numbers = np.arange(1, boxes.shape[2] + 1, dtype=np.uint8)[:, None, None]
    ids: NDArray[np.uint8] = ((inside[..., 1, :, None] & inside[..., 0, None, :]) * numbers).max(2)
    return ids


def speed(names: list[str], repeats: int, device: str, precision: str) -> Rows:
    """Yield name, weights, pictures, frames, the least times and clips/s of each model."""
    for name, options, few in MODELS:
        if name not in names:
            continue
        clips = few if device == "cpu" else 16 * few
        model: Any = build_untrained(name, **options).to(device)  # type: ignore[attr-defined]
        spec = model.spec
        window = random_clips(clips, model.window, spec).to(device)
        context = random_clips(clips, spec.context, spec).to(device)
        half = torch.autocast(device, torch.bfloat16, enabled=precision != "32-true")
        weights = sum(value.numel() for value in model.parameters())
        if name in ENCODERS:
            weights += sum(value.numel() for value in model.network().parameters())
            window = dataclasses.replace(window, features=model.encode(window))

        def train(model: Any = model, window: Batch = window, half: Any = half) -> None:
            with half:
                loss = model.train().loss(window)["loss"]
            loss.backward()

        def extract(
            model: Any = model, context: Batch = context, half: Any = half, name: str = name
        ) -> None:
            with torch.no_grad(), half:
                features = model.eval().encode(context)
                given = {"features": features} if name in ENCODERS else {}
                model.imagine(dataclasses.replace(context, **given), 1, 0)

        times = [best_time(function, repeats, device) / clips for function in (train, extract)]
        label = model.provenance().model
        cells = [label, f"{weights / 1e6:.2f} M", f"{spec.image_size} px", str(model.window)]
        yield [*cells, *(f"{seconds:.4f}" for seconds in times), *(f"{1 / s:.1f}" for s in times)]


def longest(names: list[str]) -> Rows:
    """Yield name, frames, features of a trial, memory before and at most of each model."""
    for name, options, _ in MODELS:
        if name in names and "backbone" not in options:
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
                yield pool.submit(encode_longest, name, options).result()


@torch.no_grad()
def answers(names: list[str], repeats: int) -> Rows:
    """Yield name, pictures, frames, networks, the least time of 1,000 predictions of each model."""
    for name in names:
        model: Any = build_model(name)
        clips = random_clips(ANSWERED, model.spec.context, model.spec)
        frames = torch.tensor(model.spec.context_frames()).repeat(ANSWERED, 1)
        clips = dataclasses.replace(clips, frames=frames)
        seconds = best_time(lambda model=model, clips=clips: model.predict(clips), repeats, "cpu")
        cells = [model.name, f"{model.spec.image_size} px", str(model.spec.context)]
        yield [*cells, str(model.settings.members), f"{seconds * 1000 / ANSWERED:.1f}"]


@torch.no_grad()
def encode_longest(name: str, options: dict[str, Any]) -> list[str]:
    """Encode a movie of `LONGEST` frames; return the cells of its row."""
    torch.set_num_threads(1)
    model: Any = build_untrained(name, **options)
    frames = len(model.spec.all_frames(LONGEST))
    movie = random_clips(1, frames, model.spec)
    if name in ENCODERS:
        model.network()  # its weights count before
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    (arrays,) = encode_clips(model.eval(), movie)
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    counts = [frames, arrays["features"].size, before // 1024, most // 1024]
    return [model.provenance().model, *(f"{count:,}" for count in counts)]


def best_time(function: Callable[[], None], repeats: int, device: str) -> float:
    """Return the least time of several calls, seconds: of the processor, or elapsed on a GPU."""
    clock = time.process_time if device == "cpu" else time.perf_counter
    function()
    times = []
    for _ in range(repeats):
        wait_for(device)
        start = clock()
        function()
        wait_for(device)
        times.append(clock() - start)
    return min(times)


def wait_for(device: str) -> None:
    """Wait until the GPU has done what it was given."""
    if device != "cpu":
        torch.cuda.synchronize()


def learn(folder: Path, names: list[str], steps: int, seeds: int) -> Rows:
    """Yield the metrics of testing trials by model and seed."""
    dataset = Dataset(folder)
    trials = dataset.trials("training")
    with tempfile.TemporaryDirectory() as kept:
        store = FeatureStore(Path(kept))
        for name, seed in itertools.product(names, range(seeds)):
            model: Any = build_untrained(name, seed=seed)
            source = whole_source(dataset, model.spec)
            clips = tested_clips(model, source, dataset.trials("testing"))
            features = None
            if name in DYNAMICS:
                features = store.encoded(model, source, trials, "whole").by_trial()
            before, *_ = metric(name, model, clips)
            start = time.process_time()
            trained = train_model(
                model,
                source,
                trials,
                settings=dataclasses.replace(
                    model.training_settings, steps=steps or model.training_settings.steps
                ),
                seed=seed,
                name="all",
                folder=None,
                features=None if features is None else lambda _, known=features: known,
                accelerator="cpu",
            )
            seconds = time.process_time() - start
            after, *trivial = metric(name, model, clips)
            best = (max if name == "cswm" else min)(trivial)
            values = [*metric_cells(after, before, *trivial), f"{after / best:.3f}"]
            label = model.provenance().model
            yield [label, str(seed), str(trained.steps), *values, f"{seconds:.0f}"]


def shipped(folder: Path, names: list[str]) -> Rows:
    """Yield the metrics of testing trials with shipped weights."""
    dataset = Dataset(folder)
    for name in names:
        model: Any = build_model(name, weights="shipped")
        source = whole_source(dataset, model.spec)
        clips = tested_clips(model, source, dataset.trials("testing"))
        after, *trivial = metric(name, model, clips)
        before, *_ = metric(name, build_untrained(name), clips)
        yield [model.name, METRICS[name], *metric_cells(after, before, *trivial)]


def metric_cells(
    after: float, before: float, trivial: float, empty: float | None = None
) -> list[str]:
    """Return the cells of a metric; "-" where it is not defined of an empty scene."""
    return [
        *(f"{v:.3f}" for v in (after, before, trivial)),
        "-" if empty is None else f"{empty:.3f}",
    ]


def tested_clips(model: Any, source: Any, trials: list[str]) -> list[Batch]:
    """Return one training clip of every trial, from an early frame, in batches."""
    rng = generator("tested clips")
    starts = rng.integers(LATEST_START + 1, size=len(trials)).tolist()
    groups = range(0, len(trials) - TESTED_CLIPS + 1, TESTED_CLIPS)
    if not groups:
        raise SystemExit(f"learn needs {TESTED_CLIPS} testing trials or more")
    chosen = [slice(start, start + TESTED_CLIPS) for start in groups]
    clips = [source.window(trials[part], starts[part], model.window).to("cpu") for part in chosen]
    if model.learns_from != "features":
        return clips
    return [dataclasses.replace(batch, features=model.encode(batch)) for batch in clips]


@torch.no_grad()
def metric(name: str, model: Any, clips: list[Batch]) -> list[float]:
    """Return the metric of a model and of the trivial predictors, means over the batches."""
    metrics = {
        "cswm": reciprocal_ranks,
        "rpin": center_distances,
        **dict.fromkeys(DYNAMICS, feature_errors),
    }
    model.eval()
    values = []
    with torch.random.fork_rng(devices=[]):
        for number, batch in enumerate(clips):
            torch.manual_seed(stable_hash("tested clips", number) % 2**63)
            values.append(metrics.get(name, moving_errors)(model, batch))
    return [float(value) for value in np.mean(values, axis=0)]


def reciprocal_ranks(model: Any, batch: Batch) -> tuple[float, float]:
    """Return the mean reciprocal ranks of true next states: of the model, of a copy."""
    ranks, copied = model.next_state_ranks(batch)
    return ranking(ranks).reciprocal, ranking(copied).reciprocal


def center_distances(model: Any, batch: Batch) -> tuple[float, float]:
    """Return 1000 times the distances of centres: of the model, at constant velocity."""
    own, constant = (1000 * float(value.nanmean()) for value in model.center_errors(batch))
    return own, constant


def feature_errors(model: Any, batch: Batch) -> tuple[float, float]:
    """Return 1000 times the errors of the next feature: of the model, and of the last feature."""
    unit = 1000 * float(model.scale) ** 2
    return unit * float(model.loss(batch)["loss"]), unit * float(model.baseline(batch))


def moving_errors(model: Any, batch: Batch) -> tuple[float, float, float]:
    """Return 1000 times the errors of moving pixels: of the model, a copy, and an empty scene."""
    assert batch.rgb is not None, "the clips have pictures"
    pictures = torch.as_tensor(batch.rgb).permute(0, 1, 4, 2, 3).float() / 255
    valid = torch.as_tensor(batch.valid)
    empty = empty_scene_error(pictures, model.settings.imagined, valid).moving
    own, copied = model.loss(batch)["loss"], model.baseline(batch)
    return 1000 * float(own), 1000 * float(copied), 1000 * float(empty)


def table(head: list[str], rows: Rows) -> str:
    """Return a Markdown table; print its rows as they come."""
    lines = []
    for row in rows:
        print(*row, flush=True)
        lines.append(row)
    return markdown_table(head, lines)


def write_section(path: Path, title: str, text: str) -> None:
    """Replace a section of a page, or append it."""
    known = path.read_text()
    known = re.sub(rf"\n## {re.escape(title)}\n.*?(?=\n## |\Z)", "", known, flags=re.DOTALL)
    path.write_text(f"{known.rstrip()}\n\n## {title}\n{text}\n")


def main() -> None:
    """Run one part."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("part", choices=("speed", "longest", "answers", "learn", "shipped"))
    parser.add_argument("folder", nargs="?", type=Path)
    parser.add_argument(
        "--models", nargs="+", default=(), choices=sorted({*METRICS, *ENCODERS, *INTUITION})
    )
    parser.add_argument("--steps", type=int, default=0, help="0: those of the model")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--accelerator", default="cpu", choices=("cpu", "cuda"), help="of speed")
    parser.add_argument(
        "--precision", default="32-true", choices=("32-true", "bf16-mixed"), help="of speed"
    )
    parser.add_argument("--write", action="store_true")
    options = parser.parse_args()
    both = (*SHIPPED, *ENCODERS)
    known = {"speed": both, "longest": both, "learn": tuple(METRICS), "shipped": SHIPPED}
    known["answers"] = INTUITION
    models = list(options.models or known.get(options.part, ()))
    if unknown := set(models).difference(known.get(options.part, ())):
        parser.error(f"{options.part} has no model {', '.join(sorted(unknown))}")
    if options.part == "speed":
        device, precision = options.accelerator, options.precision
        head = ["model", "weights", "pictures", "frames", "training step, s", "features, s"]
        head += ["trained clips/s", "clips/s of features"]
        title = "Processor time of a clip"
        if device != "cpu":
            title = f"Time of a clip on {torch.cuda.get_device_name()}, {precision}"
        rows = speed(models, options.repeats, device, precision)
    elif options.part == "longest":
        head = ["model", "frames", "features", "before, MB", "at most, MB"]
        title = f"Memory of the features of a movie of {LONGEST} frames"
        rows = longest(models)
    elif options.part == "answers":
        head = ["model", "pictures", "frames", "networks", "1,000 predictions, s"]
        title = "Processor time of predictions"
        rows = answers(models, options.repeats)
    elif options.folder is None:
        parser.error(f"{options.part} needs the folder of the trials")
    elif options.part == "learn":
        head = ["model", "seed", "steps", "trained", "untrained", "trivial", "empty scene"]
        head += ["ratio", "training, s"]
        title = f"What {', '.join(models)} learned of new clips"
        rows = learn(options.folder, models, options.steps, options.seeds)
    else:
        head = ["model", "metric", "trained", "untrained", "trivial", "empty scene"]
        title = "Shipped weights on new clips"
        rows = shipped(options.folder, models)
    text = table(head, rows)
    print(text)
    if options.write:
        where = f"{datetime.date.today()}, {processor()}, torch {torch.__version__}"
        threads = f"{torch.get_num_threads()} thread(s), load {os.getloadavg()[0]:.1f}"
        write_section(RESULTS, title, f"{text}\n\n{where}, {threads}.")


if __name__ == "__main__":
    main()
