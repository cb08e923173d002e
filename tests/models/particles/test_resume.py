"""Training of particle models that is interrupted and resumed."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from physion import sample_scene
from physion.clips.batch import Batch, Motion, Spec, clip_frames
from physion.clips.source import Part
from physion.models.build import build_model
from physion.models.checkpoint import WEIGHTS
from physion.models.interface import TrainingSettings
from physion.physics.engine import simulate
from physion.scenes.scene import Ending
from physion.training.train import train_model
from support.clip_source import ClipSource
from support.trained_models import equal_weights

FRAMES, STEPS = 60, 8


class Killed(Exception):
    """Stands for the end of a process."""


class Simulated(ClipSource):
    """Source of short simulated trials of Collide, without files."""

    def __init__(self, spec: Spec) -> None:
        self.spec = spec
        self._motions: dict[str, Motion] = {}
        for seed in range(4):
            scene = sample_scene("collide", seed)
            scene = dataclasses.replace(scene, ending=Ending(FRAMES, FRAMES))
            self._motions[scene.name] = Motion(scene, simulate(scene))
        self.trials = tuple(self._motions)

    def length(self, trial: str) -> int:
        return FRAMES

    def key(self, trial: str, part: Part) -> str:
        return hashlib.sha256(f"{trial} {part} {self.spec}".encode()).hexdigest()

    def clips(self, trials: Sequence[str], frames: Sequence[Sequence[int]]) -> Batch:
        clipped = [clip_frames(wanted, FRAMES) for wanted in frames]
        return Batch(
            tuple(trials),
            np.stack([frame for frame, _ in clipped]),
            np.stack([valid for _, valid in clipped]),
            state=tuple(self._motions[trial] for trial in trials),
        )


def test_a_resumed_training_gives_the_files_of_an_uninterrupted_one(tmp_path: Path) -> None:
    settings = TrainingSettings(
        steps=STEPS, batch=2, learning_rate=1e-3, schedule="cosine", warmup=2, held_out=0.25,
        validate_every=4, log_every=2, checkpoint_every=3,
    )  # fmt: skip

    source = Simulated(build_model("dpi", weights="random").spec)

    def train(folder: str, killed: int | None = None) -> tuple[Any, list[int]]:
        """Return the model and the steps that were counted."""
        counted = []

        def progress(what: str, done: int, total: int) -> None:
            counted.append(done)
            if done == killed:
                raise Killed

        model = build_model("dpi", weights="random")
        train_model(
            model, source, source.trials, seed=1, name="all", folder=tmp_path / folder,
            settings=settings, accelerator="cpu", progress=progress,
        )  # fmt: skip
        return model, counted

    def files(folder: str) -> dict[str, bytes]:
        paths = [path for path in (tmp_path / folder).rglob("*") if path.is_file()]
        # Those of TensorBoard hold the time of day.
        paths = [path for path in paths if path.parent.name != "events"]
        return {str(path.relative_to(tmp_path / folder)): path.read_bytes() for path in paths}

    whole, steps = train("whole")
    with pytest.raises(Killed):
        train("parts", killed=5)
    assert not any(Path(path).name == WEIGHTS for path in files("parts"))
    torch.rand(3)  # the state of torch's generator does not matter
    resumed, later = train("parts")
    assert steps[0] == 1 and later[0] == 4, "it goes on after the checkpoint"
    assert equal_weights(resumed, whole) and not equal_weights(
        resumed, build_model("dpi", weights="random")
    )
    assert files("parts") == files("whole")
    assert any(Path(path).name == WEIGHTS for path in files("parts"))
