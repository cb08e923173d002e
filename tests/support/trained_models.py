"""Tiny models that learn, one per input, and a source of moving values that needs no file."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from physion.clips.batch import Batch, Motion, Spec, clip_frames
from physion.clips.source import Part
from physion.core.errors import UnknownNameError
from physion.models.interface import LearnsFrom, TrainingSettings
from physion.models.torch_model import TorchModel
from support.clip_source import ClipSource
from support.hand_made import make_scene, make_trajectory

SPEC = Spec(image_size=4, stride=6, context=3, future=5, context_at="start")
QUICK = TrainingSettings(
    steps=40, batch=8, learning_rate=1e-2, log_every=10, checkpoint_every=10, validate_every=20
)


class MovingValues(ClipSource):
    """Source of trials whose pictures become brighter at a constant speed.

    ``frames`` is the length of every motion, or of each.
    """

    def __init__(self, count: int = 20, frames: int = 100, spec: Spec = SPEC) -> None:
        self.spec = spec
        self.trials = tuple(f"{('drop', 'roll')[i % 2]}_{i:04d}" for i in range(count))
        self.frames = dict.fromkeys(self.trials, frames)
        rng = np.random.default_rng(0)
        self._start = dict(zip(self.trials, rng.uniform(20, 60, count), strict=True))
        self._speed = dict(zip(self.trials, rng.uniform(0.5, 1.5, count), strict=True))
        self.read: list[tuple[tuple[str, ...], tuple[int, ...]]] = []

    def length(self, trial: str) -> int:
        return self.frames[trial]

    def window(self, trials: Sequence[str], starts: Sequence[int], length: int) -> Batch:
        self.read.append((tuple(trials), tuple(starts)))
        return super().window(trials, starts, length)

    def key(self, trial: str, part: Part) -> str:
        if trial not in self.frames:
            raise UnknownNameError("trial", trial, self.trials)
        text = f"{trial} {self.frames[trial]} {part} {self.spec}"
        return hashlib.sha256(text.encode()).hexdigest()

    def values(self, trial: str, frames: NDArray[np.int64]) -> NDArray[np.float64]:
        return self._start[trial] + self._speed[trial] * frames

    def features(self, trials: Sequence[str]) -> list[NDArray[np.float32]]:
        """Return features (T, 2) of whole clips: the brightness, and its square."""
        found = []
        for trial in trials:
            frames = np.array(self.spec.all_frames(self.frames[trial]))
            row = self.values(trial, np.minimum(frames, self.frames[trial] - 1)) / 100
            found.append(np.stack([row, row**2], axis=1).astype(np.float32))
        return found

    def clips(self, trials: Sequence[str], frames: Sequence[Sequence[int]]) -> Batch:
        clipped = [clip_frames(f, self.frames[t]) for t, f in zip(trials, frames, strict=True)]
        shown = np.stack([frame for frame, _ in clipped])
        bright = np.stack([self.values(t, f) for t, f in zip(trials, shown, strict=True)])
        size = self.spec.image_size
        rgb = np.broadcast_to(bright[..., None, None, None], (*shown.shape, size, size, 3))
        states = None
        if "state" in self.spec.inputs:
            scene = make_scene()
            states = tuple(Motion(scene, make_trajectory(scene)) for _ in trials)
        return Batch(
            trials=tuple(trials),
            frames=shown,
            valid=np.stack([valid for _, valid in clipped]),
            rgb=np.clip(rgb, 0, 255).astype(np.uint8) if "rgb" in self.spec.inputs else None,
            state=states,
        )


class NextBrightness(TorchModel):
    """Network that predicts the next brightness from pictures, features or states."""

    def __init__(
        self,
        learns_from: LearnsFrom = "clips",
        dropout: float = 0.0,
        settings: TrainingSettings = QUICK,
        hidden: int = 8,
    ) -> None:
        super().__init__()
        self.learns_from: LearnsFrom = learns_from
        self.spec = replace(SPEC, inputs=("state",)) if learns_from == "states" else SPEC
        self.window, self.training_settings = 4, settings
        inputs = {"clips": 3, "features": 6, "states": 3}[learns_from]
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            self.net = nn.Sequential(
                nn.Linear(inputs, hidden), nn.ReLU(), nn.Dropout(dropout), nn.Linear(hidden, 1)
            )
        self.center = nn.Buffer(torch.zeros(()))
        self.prepared: list[Batch] = []

    def prepare(self, sample: Batch) -> None:
        self.prepared.append(sample)
        self.center.fill_(self._brightness(sample).mean())

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        values, target = self._pair(batch)
        predicted = self.net(values)[:, 0] + values[:, -1]
        return {"loss": (predicted - target).pow(2).mean(), "bias": (predicted - target).mean()}

    def baseline(self, batch: Batch) -> Tensor:
        values, target = self._pair(batch)
        return (values[:, -1] - target).pow(2).mean()

    def encode(self, batch: Batch) -> Tensor:
        return self._brightness(batch)[..., None]

    def _pair(self, batch: Batch) -> tuple[Tensor, Tensor]:
        if self.learns_from == "features":
            values = batch.features - self.center
            return values[:, :3].flatten(1), values[:, 3, 1]
        values = self._brightness(batch) - self.center
        return values[:, :3], values[:, 3]

    def _brightness(self, batch: Batch) -> Tensor:
        if batch.features is not None:
            return batch.features[..., 0]
        if batch.state is not None:
            pairs = zip(batch.state, batch.frames.cpu().numpy() % 60, strict=True)
            heights = [motion.trajectory.positions[rows, 0, 2] for motion, rows in pairs]
            return torch.tensor(np.stack(heights), dtype=torch.float32)
        return batch.rgb.float().mean(dim=(2, 3, 4)) / 100


class SlowBrightness(NextBrightness):
    """Network that takes its time, so that a process can be killed in the middle."""

    def loss(self, batch: Batch) -> dict[str, Tensor]:
        time.sleep(0.05)
        return super().loss(batch)


def equal_weights(one: nn.Module, other: nn.Module) -> bool:
    """Return whether all weights of two networks are equal to the bit."""
    pairs: Any = zip(one.state_dict().values(), other.state_dict().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)
