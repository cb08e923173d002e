"""What particle models learn, and that an interrupted training continues."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score

from physion import sample_scene
from physion.clips.batch import Batch, Motion, Spec, clip_frames, cut_to_observed
from physion.clips.clips import whole_source
from physion.clips.source import Part
from physion.compute.local import LocalExecutor
from physion.core.seeds import generator
from physion.models.build import build_model
from physion.models.checkpoint import WEIGHTS
from physion.models.interface import TrainingSettings
from physion.models.particles.simulator import ParticleSimulator
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.readout.rollout_error import motion_error
from physion.scenes.scene import Ending
from physion.training.train import train_model
from physion.trials.dataset import Dataset
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import GenerateSettings, plan_dataset
from support.clip_source import ClipSource
from support.trained_models import equal_weights

STEPS = 1000
HORIZON = 60
"""Frames after the last observed one."""


@dataclass(frozen=True)
class Result:
    """Gaps of the tested trials, and mean errors of the model and of constant velocity, metres."""

    gaps: NDArray[np.float64]
    error: float
    constant: float


def motions_and_contacts(dataset: Dataset) -> list[tuple[Motion, bool]]:
    """Return the tested motions and whether agent and patient touch; none do while observed."""
    files = [dataset.trial(trial) for trial in dataset.trials("testing")]
    labels = [label_contact(file.scene, file.trajectory) for file in files]
    assert not any(label.observed for label in labels)
    return [
        (Motion(file.scene, file.trajectory), label.contact)
        for file, label in zip(files, labels, strict=True)
    ]


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("learning") / "data"
    tasks = plan_dataset("physion", ("collide",), {"training": 200, "testing": 200})
    settings = GenerateSettings(movies=False, jitters=0, min_visible=0.0)
    assert not make_trials(folder, tasks, settings, executor=LocalExecutor(workers=2)).failed
    return Dataset(folder)


@pytest.fixture(scope="module")
def result(dataset: Dataset) -> Result:
    """Train a model and imagine the tested trials."""
    model = build_model("dpi", seed=0, weights="random")
    assert isinstance(model, ParticleSimulator)
    train_model(
        model,
        whole_source(dataset, model.spec),
        dataset.trials("training"),
        settings=dataclasses.replace(model.training_settings, steps=STEPS),
        seed=0,
        name="all",
        folder=None,
        accelerator="cpu",
    )
    motions = [m for m, _ in motions_and_contacts(dataset)]
    cut = [Motion(m.scene, cut_to_observed(m.scene, m.trajectory)) for m in motions]
    futures = model.futures(cut, 1, 0)
    gaps = model.gaps(cut, futures)[:, 0]
    errors = []
    for motion, ((particles, poses),) in zip(motions, futures, strict=True):
        rows = motion_error(motion, particles, poses, model.spec.stride, HORIZON)
        errors.append(rows.iloc[-1][["error", "constant_velocity_error"]])
    error, constant = np.mean(np.array(errors, float), axis=0)
    return Result(gaps, float(error), float(constant))


@pytest.fixture(scope="module")
def contacts(dataset: Dataset) -> NDArray[np.bool_]:
    return np.array([contact for _, contact in motions_and_contacts(dataset)])


@pytest.mark.slow
def test_contacts_are_distinguished_from_misses(
    result: Result, contacts: NDArray[np.bool_]
) -> None:
    """The standard error of an AUC of .9 from 200 trials is .02; that of chance is .5."""
    assert roc_auc_score(contacts, -result.gaps) >= 0.85


@pytest.mark.slow
def test_objects_are_nearer_to_the_truth_than_with_constant_velocity(result: Result) -> None:
    assert result.error <= 0.30 * result.constant


@pytest.mark.slow
def test_permuted_labels_are_not_predicted(result: Result, contacts: NDArray[np.bool_]) -> None:
    """For n/2 contacts, the AUC of chance has the variance (n + 1) / (3 n^2)."""
    n = len(contacts)
    permuted = contacts[generator("permuted labels", 0).permutation(n)]
    auc = roc_auc_score(permuted, -result.gaps)
    assert abs(auc - 0.5) < 3 * np.sqrt((n + 1) / (3 * n * n))


# Training of particle models that is interrupted and resumed.

FRAMES, LAST_STEP = 60, 8


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
        steps=LAST_STEP, batch=2, learning_rate=1e-3, schedule="cosine", warmup=2, held_out=0.25,
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
