"""What particle models learn, and that an interrupted training continues."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sklearn.metrics import roc_auc_score

from physion.clips.batch import Batch, Motion, Spec, clip_frames, cut_to_observed
from physion.clips.source import Part
from physion.core.seeds import generator
from physion.models.build import build_model
from physion.models.checkpoint import WEIGHTS
from physion.models.interface import TrainingSettings
from physion.models.particles.simulator import ParticleSimulator
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.readout.rollout_error import motion_error
from physion.scenes.scene import Body, Camera, Ending, Roles, Scene
from physion.training.train import train_model
from support.clip_source import ClipSource
from support.trained_models import equal_weights

# A cube falls for a second towards a plate, at different places: some of them miss it.

TRAINED, TESTED, STEPS, FRAMES = 24, 60, 250, 100
HORIZON = 45
"""Frames after the last observed one."""


def falling(offset: float, height: float) -> Motion:
    """Return a cube that falls onto a low plate of 0.8 m, or past it."""
    bodies = (
        Body("cube", "cube", (offset, 0.0, height), (0.2, 0.2, 0.2)),
        Body("plate", "cube", (0.0, 0.0, 0.0), (0.8, 0.8, 0.2)),
    )
    scene = Scene(
        f"falling {offset} {height}", "drop", bodies, Roles("cube", "plate"),
        Camera((3.0, 0.0, 1.0)), ending=Ending(FRAMES, FRAMES),
    )  # fmt: skip
    return Motion(scene, simulate(scene))


def many_falls(count: int, seed: int) -> list[Motion]:
    rng = np.random.default_rng(seed)
    return [falling(*rng.uniform((0.0, 2.0), (1.0, 2.6))) for _ in range(count)]


class Simulated(ClipSource):
    """Source of simulated motions of `FRAMES` frames, without files."""

    def __init__(self, spec: Spec, motions: Sequence[Motion]) -> None:
        self.spec = spec
        self._motions = {motion.scene.name: motion for motion in motions}
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


@pytest.mark.nightly
@pytest.mark.slow
def test_contacts_and_motions_of_falls_that_were_not_seen_are_learned() -> None:
    model = build_model("dpi", seed=0, weights="random")
    assert isinstance(model, ParticleSimulator)
    source = Simulated(model.spec, many_falls(TRAINED, 0))
    settings = dataclasses.replace(model.training_settings, steps=STEPS, batch=8)
    train_model(
        model, source, source.trials, settings=settings, seed=0, name="all", folder=None,
        accelerator="cpu",
    )  # fmt: skip
    motions = many_falls(TESTED, 1)
    labels = [label_contact(m.scene, m.trajectory) for m in motions]
    assert not any(label.observed for label in labels)
    cut = [Motion(m.scene, cut_to_observed(m.scene, m.trajectory)) for m in motions]
    futures = model.futures(cut, 1, 0)
    errors = []
    for motion, ((particles, poses),) in zip(motions, futures, strict=True):
        rows = motion_error(motion, particles, poses, model.spec.stride, HORIZON)
        errors.append(rows.iloc[-1][["error", "constant_velocity_error"]])
    error, constant = np.mean(np.array(errors, float), axis=0)
    contacts = np.array([label.contact for label in labels])
    gaps = model.gaps(cut, futures)[:, 0]
    assert 15 < contacts.sum() < 45 and roc_auc_score(contacts, -gaps) >= 0.9
    print(error, constant)
    assert error <= 0.30 * constant
    # Of permuted labels nothing is known: for n/2 contacts, chance has the variance below.
    permuted = contacts[generator("permuted labels", 0).permutation(TESTED)]
    deviation = np.sqrt((TESTED + 1) / (3 * TESTED * TESTED))
    assert abs(roc_auc_score(permuted, -gaps) - 0.5) < 3 * deviation


# Training of particle models that is interrupted and resumed.

LAST_STEP = 8


class Killed(Exception):
    """Stands for the end of a process."""


def test_a_resumed_training_gives_the_files_of_an_uninterrupted_one(tmp_path: Path) -> None:
    settings = TrainingSettings(
        steps=LAST_STEP, batch=2, learning_rate=1e-3, schedule="cosine", warmup=2, held_out=0.25,
        validate_every=4, log_every=2, checkpoint_every=3,
    )  # fmt: skip

    source = Simulated(build_model("dpi", weights="random").spec, many_falls(4, 0))

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
