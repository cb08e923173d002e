"""Store of features: what is kept, what is computed again, and what is refused."""

from __future__ import annotations

import hashlib
import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from torch import nn

from physion.errors import BadInputError
from physion.models.batch import Batch, Provenance, Rollout, Spec
from physion.readout.feature_file import open_features
from physion.readout.feature_store import FeatureStore
from physion.readout.model_calls import OutOfMemoryError

SPEC = Spec(image_size=2, context=3, future=4)
TRIALS = ("roll_1", "roll_2", "drop_1", "drop_2", "link_1")


def sha(*parts: Any) -> str:
    return hashlib.sha256(repr(parts).encode()).hexdigest()


@dataclass
class Movies:
    """Whole source whose pixels follow from the names of trials; it counts what is read."""

    spec: Spec = SPEC
    trials: tuple[str, ...] = TRIALS
    version: int = 0
    read: list[tuple[str, ...]] = field(default_factory=list)

    def _clips(self, trials: Sequence[str], frames: tuple[int, ...]) -> Batch:
        self.read.append(tuple(trials))
        pixels = [
            np.random.default_rng([self.version, *trial.encode(), frame]).integers(
                0, 255, (2, 2, 3)
            )
            for trial in trials
            for frame in frames
        ]
        shape = (len(trials), len(frames))
        return Batch(
            tuple(trials),
            frames=np.tile(np.array(frames, np.int64), (len(trials), 1)),
            valid=np.ones(shape, bool),
            rgb=np.array(pixels, np.uint8).reshape(*shape, 2, 2, 3),
        )

    def context(self, trials: Sequence[str]) -> Batch:
        return self._clips(trials, self.spec.context_frames())

    def later(self, trials: Sequence[str]) -> Batch:
        return self._clips(trials, self.spec.future_frames())

    def whole(self, trials: Sequence[str]) -> Batch:
        return self._clips(trials, self.spec.all_frames())

    def key(self, trial: str, part: str) -> str:
        return sha(self.version, trial, part, self.spec)


class ObservedMovies:
    """The observed part alone of `Movies`."""

    def __init__(self, movies: Movies) -> None:
        self.spec, self.trials = movies.spec, movies.trials
        self.context, self.key = movies.context, movies.key


class Network(nn.Module):
    """One linear layer on pixels, and dropout, which evaluation mode switches off."""

    spec = SPEC

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.layer, self.dropout = nn.Linear(12, 5), nn.Dropout(0.5)
        self.dynamics = nn.Linear(5, 5)

    def provenance(self) -> Provenance:
        return Provenance("network", "random")

    def digest(self) -> str:
        return sha([(name, value.tolist()) for name, value in self.state_dict().items()])

    def encode(self, batch: Batch) -> Any:
        assert isinstance(batch.rgb, torch.Tensor) and torch.is_inference_mode_enabled()
        return self.dropout(self.layer(batch.rgb.flatten(2).float() / 255))

    def imagine(self, context: Batch, samples: int, seed: int, **knobs: float) -> Rollout:
        last = self.dynamics(context.features[:, -1]) * knobs.get("scale", 1.0)
        steps = torch.arange(1, SPEC.future + 1)[:, None]
        futures = torch.stack([last[:, None] * steps + sample for sample in range(samples)], 1)
        return Rollout(features=futures, gap=futures.mean((2, 3)).double())


class Numpy:
    """Model without torch; ``give`` makes the features from pixels."""

    spec = SPEC

    def __init__(
        self, give: Callable[[Any], Any] = lambda x: x.reshape(*x.shape[:2], -1) / 2
    ) -> None:
        self.give, self.version = give, 0

    def provenance(self) -> Provenance:
        return Provenance("plain", "none")

    def digest(self) -> str:
        return sha("plain", self.version)

    def encode(self, batch: Batch) -> Any:
        assert isinstance(batch.rgb, np.ndarray)
        return self.give(batch.rgb.astype(np.float32))


def files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


@pytest.mark.parametrize("kind", [Network, Numpy])
@pytest.mark.parametrize("part", ["context", "later", "whole"])
def test_features_are_those_of_the_model_and_are_computed_once(
    tmp_path: Path, kind: Any, part: Any
) -> None:
    model, movies = kind(), Movies()
    in_memory = FeatureStore(None, batch=2).encoded(model, movies, TRIALS, part)
    frames = {"context": 3, "later": 4, "whole": 7}[part]
    assert in_memory.shape == (5, frames, 5 if kind is Network else 12)
    batch = getattr(movies, part)(TRIALS)
    if kind is Network:
        with torch.inference_mode():
            expected = model.layer(torch.tensor(batch.rgb).flatten(2).float() / 255).numpy()
    else:
        expected = model.encode(batch)
    assert in_memory.array() == pytest.approx(expected, abs=1e-6)
    store = FeatureStore(tmp_path, batch=2)
    first = store.encoded(model, movies, TRIALS[:3], part)
    assert len(files(tmp_path)) == 3
    movies.read.clear()
    again = store.encoded(model, movies, [TRIALS[4], TRIALS[1], TRIALS[4], TRIALS[0]], part)
    assert movies.read == [(TRIALS[4],)], "what is stored is not computed again"
    assert (again.array() == in_memory.array()[[4, 1, 4, 0]]).all()
    assert (first.array() == in_memory.array()[:3]).all()
    assert again.array().dtype == np.float32
