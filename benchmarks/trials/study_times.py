"""Times of the 11 models of the paper, size ``paper``, for `study_plan`.

Eight trials are made, one of each scenario, with movies of 256 pixels. With them are measured:

- ``step``: training of a clip, forward, backward and optimiser, by the package's own loop; and
  ``validate``, its loss without gradient. A CPU gets smaller batches than those of the settings
  (`CPU_CLIPS`): there the time of a clip does not depend on its batch.
- ``encode_context``, ``encode_whole``, ``imagine``: features of the observed frames of a trial, of
  all frames of its clip, and the imagined ones. A particle model makes 1 step and then 5 of a
  rollout. The differences give its start and its step, and a trial has as many steps as its true
  motion: networks without training do not come to rest when they should.
- ``read_...``: reading of the clips from movies and trial files, on cores. ``read_window_new`` is
  that of trials that were not read before, of which RPIN renders the boxes.
- the readout of 1000 trials, predicting 150, at two numbers of features; its time is taken to be
  linear in them.

All times are the least of a few: processor time, or, on a GPU, time of the clock with all kernels
finished, and processor time for reading and readout. Networks have one thread and random weights.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from physion import Dataset, build_model
from physion.clips.batch import LAST_OBSERVED, Batch, Motion, cut_to_observed
from physion.clips.clips import observed_source, whole_source
from physion.compute.local import SerialExecutor
from physion.core.seeds import generator
from physion.models.interface import can
from physion.models.particles.rollout import roll_out
from physion.models.particles.simulator import join_futures, observed_start
from physion.readout.features import encode_clips, imagine_clips
from physion.readout.logistic import fit_readout
from physion.scenes.scene import FRAME_TIME
from physion.training.devices import Devices, make_fabric, move_to_device
from physion.training.loop import TrainingData, TrainingLoop, evaluating, losses_of
from physion.training.windows import ClipWindows, FeatureWindows, Request, Windows
from physion.trials.making.generate import generate
from physion.trials.making.plan import FULL_COUNTS, GenerateSettings

MODELS = (
    "svg", "op3", "cswm", "rpin", "pVGG-mlp", "pVGG-lstm", "pDeIT-mlp", "pDeIT-lstm",
    "gns", "gns-ransac", "dpi",
)  # fmt: skip
CPU_CLIPS = {"svg": 2, "op3": 2, "cswm": 4, "rpin": 1, "gns": 8, "gns-ransac": 8, "dpi": 8}
"""Clips of a measured training step on a CPU, where they are fewer than those of the settings."""
ENCODER_BATCH = 4
"""Trials that are encoded, and of which a future is imagined, together; on a CPU 1 is encoded."""
STEPS = 3
"""Training steps, of which the first does not count."""
LONG = 5.0
"""Seconds after which nothing is repeated."""
ROLLOUT_STEPS = (1, 5)
WIDTHS = (20_000, 80_000)
"""Numbers of features of the measured readouts."""


@dataclass(frozen=True, kw_only=True)
class ModelTimes:
    """Facts about a model and its seconds for one clip or trial; see the module."""

    name: str
    learns_from: str
    encoder: str
    boxes: int
    steps: int
    batch: int
    measured_batch: int
    validate_every: int
    calibration_trials: int
    context: int
    whole: int
    feature_size: int
    step: float
    validate: float
    read_window: float
    read_window_new: float
    encode_context: float = 0.0
    encode_whole: float = 0.0
    imagine: float
    read_context: float
    read_whole: float = 0.0


class OneBatch:
    """Windows that are the same batch each time, so that nothing is read while steps are timed."""

    def __init__(self, windows: Windows, batch: Batch) -> None:
        self.trials, self.starts, self.sample = windows.trials, windows.starts, windows.sample
        self._batch = batch

    def read(self, _: Request) -> Batch:
        """Return the batch."""
        return self._batch


@dataclass(frozen=True)
class Clock:
    """Clock of a device: processor time, or time after all kernels of a GPU."""

    device: torch.device

    def now(self) -> float:
        """Return the present second."""
        if self.device.type == "cpu":
            return time.process_time()
        torch.cuda.synchronize()
        return time.perf_counter()

    def least(self, function: Callable[[], Any]) -> float:
        """Return the least time of three calls, the first apart; that of the first if it is long.

        The first call also sets up what later ones use.
        """
        times = []
        while len(times) < 3 and (len(times) != 1 or times[0] < LONG):
            start = self.now()
            function()
            times.append(self.now() - start)
        return min(times[1:] or times)


CORE = Clock(torch.device("cpu"))


def make_trials(folder: Path) -> Dataset:
    """Make a trial of each scenario."""
    settings = GenerateSettings(jitters=0)
    return generate(folder, "all", {"training": 1}, settings=settings, executor=SerialExecutor())


def cycled(windows: Windows, clips: int, seed: int) -> Request:
    """Return so many random windows of the trials in turn."""
    rows = [row % len(windows.trials) for row in range(clips)]
    starts = windows.starts(rows, generator("study times", seed))
    return Request(tuple(windows.trials[row] for row in rows), tuple(map(int, starts)))


def measure_model(name: str, dataset: Dataset) -> ModelTimes:
    """Return the times of a model on the GPU, if torch sees one, or on a core."""
    random = {"weights": "random"} if name.startswith("p") else {}
    model: Any = build_model(name, size="paper", **random)
    fabric = make_fabric(Devices(), model.training_settings.precision)
    move_to_device(fabric, model)
    clock = Clock(fabric.device)
    batch = model.training_settings.batch
    slow = clock.device.type == "cpu"
    clips = min(batch, CPU_CLIPS.get(name, batch)) if slow else batch
    evaluated = evaluate_times(model, dataset, 1 if slow else ENCODER_BATCH, clock)
    windows, reading = read_times(model, dataset, evaluated["feature_size"])
    return ModelTimes(
        name=name,
        learns_from=model.learns_from,
        encoder=getattr(model.settings, "encoder", ""),
        boxes=model.spec.objects if "boxes" in model.spec.inputs else 0,
        steps=model.training_settings.steps,
        batch=batch * model.training_settings.accumulate,
        measured_batch=clips,
        validate_every=model.training_settings.validate_every,
        calibration_trials=getattr(model, "calibration_trials", 0),
        context=model.spec.context,
        whole=round(float(np.mean([len(model.spec.all_frames(n)) for n in lengths_of(dataset)]))),
        **evaluated,
        **reading,
        **train_times(model, windows, clips, fabric, clock),
    )


def lengths_of(dataset: Dataset) -> list[int]:
    """Return the frames of the trials."""
    frames = dict(zip(dataset.index["trial"], dataset.index["frames"], strict=True))
    return [int(frames[trial]) for trial in dataset.trials("training")]


def read_times(model: Any, dataset: Dataset, features: int) -> tuple[Windows, dict[str, float]]:
    """Return the windows of the trials, and the seconds to read one: again, and a new one."""
    trials = tuple(dataset.trials("training"))
    if model.learns_from == "features":
        rng, lengths = generator("study times"), lengths_of(dataset)
        shapes = [(len(model.spec.all_frames(length)), features) for length in lengths]
        values = [rng.normal(size=shape).astype(np.float32) for shape in shapes]
        rows = np.arange(len(trials))
        stored = FeatureWindows(model.spec, trials, values, lengths, rows, model.window)
        again = CORE.least(lambda: stored.read(cycled(stored, len(trials), 0))) / len(trials)
        return stored, {"read_window": again, "read_window_new": again}
    chooses = model if can(model, "start_probabilities") else None
    for _ in range(2):  # what all sources have in common is loaded by the first
        source = whole_source(dataset, model.spec)
        windows = ClipWindows(source, trials, model.window, chooses)
        requests = [cycled(windows, len(trials), seed) for seed in range(3)]
        # The second renders all boxes of a trial.
        times = [once(windows.read, request) / len(trials) for request in requests]
    return windows, {"read_window": times[2], "read_window_new": times[0]}


def train_times(
    model: Any, windows: Windows, clips: int, fabric: Any, clock: Clock
) -> dict[str, float]:
    """Return the seconds of a clip in a training step, and in a validation."""
    batch = windows.read(cycled(windows, clips, 3))
    with evaluating(model, fabric):
        model.prepare(windows.sample(0).to(clock.device))
        validate = clock.least(lambda: losses_of(model, batch.to(clock.device)))
    settings = dataclasses.replace(
        model.training_settings, steps=STEPS, batch=clips, accumulate=1, schedule="constant"
    )
    ends: list[float] = []
    loop = TrainingLoop(
        model, TrainingData(OneBatch(windows, batch), None), settings, 0, fabric,
        folder=None, describe={}, progress=lambda done, total: ends.append(clock.now()),
    )  # fmt: skip
    loop.run()
    return {"step": float(np.diff(ends).min()) / clips, "validate": validate / clips}


def evaluate_times(model: Any, dataset: Dataset, clips: int, clock: Clock) -> dict[str, Any]:
    """Return the seconds of a trial in an evaluation, and the number of features of a frame."""
    trials = dataset.trials("training")
    if not can(model, "encode"):
        source = whole_source(dataset, model.spec)
        read = once(source.whole, trials) / len(trials)
        motions = list(source.whole(trials).state or ())
        return {
            "imagine": rollout_seconds(model, motions, clock),
            "read_context": read,
            "feature_size": 0,
        }
    for _ in range(2):
        observed, source = observed_source(dataset, model.spec), whole_source(dataset, model.spec)
        read_context = once(observed.context, trials) / len(trials)
        read_whole = once(source.whole, trials) / len(trials)
    context, whole = observed.context(trials[:clips]), source.whole(trials[:clips])
    features = np.stack([arrays["features"] for arrays in encode_clips(model, context)])
    future = model.spec.steps_after(max(lengths_of(dataset)))
    known = dataclasses.replace(context, features=features, future=future)
    return {
        "encode_context": clock.least(lambda: encode_clips(model, context)) / clips,
        "encode_whole": clock.least(lambda: encode_clips(model, whole)) / clips,
        "imagine": clock.least(lambda: imagine_clips(model, known, model.samples, 0, {})) / clips,
        "read_context": read_context,
        "read_whole": read_whole,
        "feature_size": features.shape[-1],
    }


def once(function: Callable[..., Any], *arguments: Any) -> float:
    """Return the processor time of one call."""
    start = CORE.now()
    function(*arguments)
    return CORE.now() - start


@torch.no_grad()
def rollout_seconds(model: Any, motions: Sequence[Motion], clock: Clock) -> float:
    """Return the seconds of a trial's rollout, with the smallest distance, 4 trials together."""
    model.eval()
    stride = model.spec.stride
    frames = range(LAST_OBSERVED % stride, LAST_OBSERVED + 1, stride)
    cut = [
        Motion(motion.scene, cut_to_observed(motion.scene, motion.trajectory)) for motion in motions
    ]

    def imagine(steps: int) -> None:
        for row in range(0, len(cut), ENCODER_BATCH):
            group = cut[row : row + ENCODER_BATCH]
            starts = [
                dataclasses.replace(observed_start(m, frames, model.settings.sampling), steps=steps)
                for m in group
            ]
            later = roll_out(starts, model.step, clock.device, FRAME_TIME * stride)
            model.gaps(group, join_futures(starts, later, 1))

    imagine(1)  # compiles
    few, many = (clock.least(lambda n=steps: imagine(n)) / len(cut) for steps in ROLLOUT_STEPS)
    step = (many - few) / (ROLLOUT_STEPS[1] - ROLLOUT_STEPS[0])
    steps = float(np.mean([(len(m.trajectory) - 1 - LAST_OBSERVED) // stride for m in motions]))
    return few + step * (steps - ROLLOUT_STEPS[0])


def measure_readout() -> dict[str, float]:
    """Return the seconds of a readout: those of any, and those for every feature."""
    fit, test = FULL_COUNTS["readout"], FULL_COUNTS["testing"]
    rng = generator("study times", "readout")
    factors = rng.standard_normal((fit + test, 20), np.float32)
    labels = factors[:fit, :4].sum(1) + rng.normal(size=fit) > 0
    seconds = []
    for width in WIDTHS:
        features = factors @ rng.standard_normal((20, width), np.float32)
        features += rng.standard_normal(features.shape, np.float32)
        seconds.append(once(fit_readout, features[:fit], labels, features[fit:]))
    slope = (seconds[1] - seconds[0]) / (WIDTHS[1] - WIDTHS[0])
    return {"any": seconds[0] - slope * WIDTHS[0], "feature": slope}
