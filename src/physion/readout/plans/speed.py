"""How long trainings take: times of earlier ones, or of a few steps that are made for it."""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from statistics import median
from typing import Any

from physion.compute.tasks import Progress
from physion.core.errors import PhysionError
from physion.readout.trainings import PlannedTraining, SharedTrainConfig, Trainer
from physion.training.loop import TrainingOverrides
from physion.trials.dataset import Dataset

_STEPS, _TRIALS, _LIMIT = 6, 2, 10.0
"""Steps and trials of a measurement, and seconds after which no further step is made."""
_TRAINING, _FEATURES = "training ", "features"
"""Stages of a training, as its progress names them."""


@dataclass(frozen=True)
class Speed:
    """Seconds that a training takes.

    - ``step``: of a step, with validation and checkpoints where they were made.
    - ``trial``: of the features of a whole trial, 0 where none are stored.
    - ``rest``: before the first and after the last step.
    """

    step: float
    trial: float
    rest: float

    def seconds(self, steps: int, new_trials: int) -> float:
        """Return the seconds of a training that computes the features of ``new_trials``."""
        return steps * self.step + new_trials * self.trial + self.rest


class Meter:
    """Times of the stages of one training, which passes its progress on.

    Parameters
    ----------
    encoder_batch
        Trials of which features are computed at a time.
    progress
        Learns what this object learns.
    """

    def __init__(self, encoder_batch: int, progress: Progress | None = None) -> None:
        self._batch, self._progress = encoder_batch, progress
        self._start = self._last = time.perf_counter()
        self._steps, self._step_seconds = 0, 0.0
        self._groups, self._group_seconds = 0, 0.0
        self._begun = False

    def __call__(self, what: str, done: int, total: int) -> None:
        """Take the time of a step, or of an encoder batch, that is finished now."""
        now = time.perf_counter()
        passed, self._last = now - self._last, now
        if what.startswith(_TRAINING):
            # The first step also sets up the network, so that the second is the first to count.
            self._steps += self._begun
            self._step_seconds += passed if self._begun else 0.0
            self._begun = True
        elif what == _FEATURES and done:
            self._groups += 1
            self._group_seconds += passed
        if self._progress is not None:
            self._progress(what, done, total)

    @property
    def elapsed(self) -> float:
        """Seconds since the object was made."""
        return time.perf_counter() - self._start

    @property
    def speed(self) -> Speed | None:
        """Speed of a training that is finished; None if it made no second step."""
        if not self._steps:
            return None
        trial = self._group_seconds / (self._groups * self._batch) if self._groups else 0.0
        rest = max(0.0, self.elapsed - self._step_seconds - self._group_seconds)
        return Speed(self._step_seconds / self._steps, trial, rest)


class _MeasuredError(Exception):
    """End of a measurement."""


def measure_speed(
    dataset: Dataset,
    model: Any,
    overrides: TrainingOverrides,
    shared: SharedTrainConfig,
    planned: PlannedTraining,
    seed: int,
) -> Speed:
    """Return the speed of a training, from a few steps on two of its trials; nothing is kept.

    It is that of one device, without validation, and without what follows the last step.

    Raises `PhysionError` if the training fails.
    """
    shared = dataclasses.replace(shared, encoder_batch=1, devices=1, nodes=1)
    short = dataclasses.replace(overrides, steps=_STEPS, held_out=0.0, schedule="constant")
    trainer = Trainer(dataset, model, None, short, shared)

    def stop_early(what: str, done: int, total: int) -> None:
        if what.startswith(_TRAINING) and done > 1 and (done == total or meter.elapsed > _LIMIT):
            raise _MeasuredError

    meter = Meter(1, stop_early)
    few = dataclasses.replace(planned, trials=planned.trials[:_TRIALS])
    with contextlib.suppress(_MeasuredError):
        trainer.train(few, seed, meter)
    speed = meter.speed
    if speed is None:
        raise PhysionError(f"the speed of {planned.name} was not measured: no step was made")
    return dataclasses.replace(speed, rest=0.0)


def typical_speed(speeds: Iterable[Mapping[str, float]]) -> Speed | None:
    """Return the median speed of earlier trainings; None without any.

    Trainings that found all features stored do not count for ``trial``.
    """
    known = [Speed(**values) for values in speeds]
    if not known:
        return None
    trial = [speed.trial for speed in known if speed.trial > 0]
    return Speed(
        median(speed.step for speed in known),
        median(trial) if trial else 0.0,
        median(speed.rest for speed in known),
    )
