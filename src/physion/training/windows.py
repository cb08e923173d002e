"""Training clips: which windows of which trials a step receives, a function of seed and step."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from physion.clips.batch import Batch, Spec, clip_frames
from physion.clips.source import WholeSource
from physion.core.errors import BadInputError
from physion.core.seeds import generator
from physion.models.interface import Model, ask

Floats = NDArray[np.float32]

SAMPLE_CLIPS = 64
"""Clips from which a model sets its statistics, unless it is trained on features."""
VALIDATION_CLIPS = 256
"""Largest number of clips of a validation."""
SAMPLE_FEATURES = 2048
"""Windows of features from which a model sets its statistics."""


def window_length(model: Model) -> int:
    """Return the frames of a training clip of a model.

    Without a ``window`` they are context and future of its spec; or twice the context, where the
    future depends on the movie.
    """
    spec = model.spec
    usual = spec.context + (spec.context if spec.future is None else spec.future)
    return int(ask(model, "window") or usual)


@dataclass(frozen=True)
class Request:
    """Windows to be read: names of trials, and the first frame or time step of each."""

    trials: tuple[str, ...]
    starts: tuple[int, ...]

    def part(self, index: int, parts: int) -> Request:
        """Return part ``index`` of ``parts`` equal parts."""
        size = len(self.trials) // parts
        chosen = slice(index * size, (index + 1) * size)
        return Request(self.trials[chosen], self.starts[chosen])


@dataclass(frozen=True)
class ClipWindows:
    """Windows of ``length`` frames, ``spec.stride`` apart, from any frame of a trial.

    A window of a trial that is shorter than a window starts at frame 0. ``chooses`` says which
    starts are more frequent than others; without it all are equally frequent.
    """

    source: WholeSource
    trials: tuple[str, ...]
    length: int
    chooses: Model | None = None
    _probabilities: dict[int, NDArray[np.float64]] = field(default_factory=dict, repr=False)

    def starts(self, trials: Sequence[int], rng: np.random.Generator) -> NDArray[np.int64]:
        """Return random first frames such that the windows end within their trials."""
        if self.chooses is not None:
            chosen = [self._chosen(self.chooses, row) for row in trials]
            return np.array([rng.choice(len(p), p=p) for p in chosen], np.int64)
        span = (self.length - 1) * self.source.spec.stride
        lengths = [self.source.length(self.trials[row]) for row in trials]
        return rng.integers(np.maximum(np.array(lengths, np.int64) - span, 1))

    def read(self, request: Request) -> Batch:
        """Return the windows of a request."""
        return self.source.window(request.trials, request.starts, self.length)

    def sample(self, seed: int) -> Batch:
        """Return up to `SAMPLE_CLIPS` random windows."""
        rng = generator("sample", seed)
        return self.read(_draw(self, min(SAMPLE_CLIPS, len(self.trials)), rng, distinct=True))

    def _chosen(self, model: Model, row: int) -> NDArray[np.float64]:
        if row not in self._probabilities:
            (motion,) = self.source.whole([self.trials[row]]).state or ()
            self._probabilities[row] = model.start_probabilities(motion)
        return self._probabilities[row]


class TrialFeatures(Protocol):
    """Features (T, D) float32 of a trial: an array, or something that reads time steps of one."""

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of time steps, and of features."""
        ...

    def __getitem__(self, steps: slice) -> Floats:
        """Return a range of time steps."""
        ...


class FeatureWindows:
    """Windows of ``length`` time steps of stored features, from anywhere in a movie.

    A window of a trial that has fewer time steps repeats the last one.

    Parameters
    ----------
    spec
        What the clips are, of which the features are.
    trials
        Names of n trials.
    features
        Features (T, D) of the whole clip of each; windows are read when they are needed.
    frames
        Number of frames of each trial's motion.
    rows
        Row numbers of the trials from which windows are drawn.
    length
        Time steps of a window.
    """

    def __init__(
        self,
        spec: Spec,
        trials: Sequence[str],
        features: Sequence[TrialFeatures],
        frames: Sequence[int],
        rows: NDArray[np.int64],
        length: int,
    ) -> None:
        clipped = [clip_frames(spec.all_frames(count), count) for count in frames]
        for trial, own, (shown, _) in zip(trials, features, clipped, strict=True):
            if len(own.shape) != 2 or own.shape[0] != len(shown):
                raise BadInputError(
                    f"features of the clip of {len(shown)} frames of trial {trial!r} must have the "
                    f"shape ({len(shown)}, size), not {tuple(own.shape)}"
                )
        self._features, self._clipped, self._length = features, clipped, length
        self._rows = {trials[row]: int(row) for row in rows}

    @property
    def trials(self) -> tuple[str, ...]:
        """Trials from which windows are drawn."""
        return tuple(self._rows)

    def starts(self, trials: Sequence[int], rng: np.random.Generator) -> NDArray[np.int64]:
        """Return random first time steps such that the windows end within their trials."""
        chosen = list(self._rows.values())
        steps = np.array([self._features[chosen[row]].shape[0] for row in trials], np.int64)
        return rng.integers(np.maximum(steps - self._length + 1, 1))

    def read(self, request: Request) -> Batch:
        """Return the windows of a request."""
        pairs = zip(request.trials, request.starts, strict=True)
        windows = [self._window(self._rows[trial], start) for trial, start in pairs]
        frames, valid, features = (np.stack(part) for part in zip(*windows, strict=True))
        return Batch(trials=request.trials, frames=frames, valid=valid, features=features)

    def context(self, trials: tuple[str, ...]) -> Batch:
        """Return the first window of trials."""
        return self.read(Request(trials, (0,) * len(trials)))

    def sample(self, seed: int) -> Batch:
        """Return a random window of each trial, up to `SAMPLE_FEATURES`."""
        rng = generator("sample", seed)
        return self.read(_draw(self, min(SAMPLE_FEATURES, len(self._rows)), rng, distinct=True))

    def _window(self, row: int, start: int) -> tuple[NDArray[np.int64], NDArray[np.bool_], Floats]:
        """Return frames, whether they exist, and features of a window."""
        (frames, valid), features = self._clipped[row], self._features[row]
        steps = np.arange(start, start + self._length)
        inside = steps < len(frames)
        last = np.minimum(steps, len(frames) - 1)
        read = features[start : start + self._length]
        return frames[last], valid[last] & inside, read[last - start]


@dataclass(frozen=True)
class LabelledContexts:
    """Contexts of trials with their outcomes, for a model that ``learns_outcomes``.

    - ``trials``: names. ``outcomes``: whether agent and patient touch, by trial.
    - ``context``: reads the context of trials. ``most``: size of a sample.
    """

    trials: tuple[str, ...]
    outcomes: Mapping[str, bool]
    context: Callable[[tuple[str, ...]], Batch]
    most: int

    def starts(self, trials: Sequence[int], rng: np.random.Generator) -> NDArray[np.int64]:
        """Return zeros: a context begins where the `Spec` says."""
        return np.zeros(len(trials), np.int64)

    def read(self, request: Request) -> Batch:
        """Return the contexts of a request, with outcomes."""
        contact = np.array([self.outcomes[trial] for trial in request.trials], np.bool_)
        return dataclasses.replace(self.context(request.trials), contact=contact)

    def sample(self, seed: int) -> Batch:
        """Return the contexts of random trials, at most ``most``."""
        rng = generator("sample", seed)
        return self.read(_draw(self, min(self.most, len(self.trials)), rng, distinct=True))


Windows = ClipWindows | FeatureWindows | LabelledContexts


def hold_out(count: int, fraction: float, seed: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return the sorted rows for training and those held out for validation.

    ``fraction`` of ``count`` rows is held out, but at least one if there are two or more; a single
    row is used for both. A ``fraction`` of 0 holds out nothing.
    """
    rows = np.arange(count)
    if fraction == 0:
        return rows, rows[:0]
    if count < 2:
        return rows, rows
    held = min(count - 1, max(1, round(fraction * count)))
    order = generator("hold out", seed).permutation(count)
    return np.sort(order[held:]), np.sort(order[:held])


def step_request(windows: Windows, size: int, seed: int, step: int) -> Request:
    """Return the ``size`` windows of a step of the optimiser, a function of seed and step."""
    return _draw(windows, size, generator("batch", seed, step))


def validation_requests(windows: Windows, size: int, seed: int) -> list[Request]:
    """Return one window of each trial, at most `VALIDATION_CLIPS`, in batches of ``size``."""
    rng = generator("validation", seed)
    drawn = _draw(windows, min(VALIDATION_CLIPS, len(windows.trials)), rng, distinct=True)
    bounds = range(0, len(drawn.trials), size)
    return [Request(drawn.trials[a : a + size], drawn.starts[a : a + size]) for a in bounds]


def _draw(
    windows: Windows, size: int, rng: np.random.Generator, *, distinct: bool = False
) -> Request:
    count = len(windows.trials)
    rows = rng.permutation(count)[:size] if distinct else rng.integers(count, size=size)
    starts = windows.starts([int(row) for row in rows], rng)
    return Request(tuple(windows.trials[row] for row in rows), tuple(int(s) for s in starts))
