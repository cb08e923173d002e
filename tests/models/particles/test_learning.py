"""What DPI-Net (small) learns in a minute: contacts and motion of Collide.

Three seeds and more steps: `benchmarks/models/particles.py`.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray
from sklearn.metrics import roc_auc_score

from physion.clips.batch import Motion, cut_to_observed
from physion.clips.clips import whole_source
from physion.compute.local import LocalExecutor
from physion.core.seeds import generator
from physion.models.build import build_model
from physion.models.particles.simulator import ParticleSimulator
from physion.physics.labels import label_contact
from physion.readout.rollout_error import motion_error
from physion.training.train import train_model
from physion.trials.dataset import Dataset
from physion.trials.making.generate import make_trials
from physion.trials.making.plan import GenerateSettings, plan_dataset

pytestmark = pytest.mark.slow

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
        errors.append(rows.iloc[-1][["Error", "Constant Velocity Error"]])
    error, constant = np.mean(np.array(errors, float), axis=0)
    return Result(gaps, float(error), float(constant))


@pytest.fixture(scope="module")
def contacts(dataset: Dataset) -> NDArray[np.bool_]:
    return np.array([contact for _, contact in motions_and_contacts(dataset)])


def test_contacts_are_told_from_misses(result: Result, contacts: NDArray[np.bool_]) -> None:
    """The standard error of an AUC of .9 from 200 trials is .02; that of chance is .5."""
    assert roc_auc_score(contacts, -result.gaps) >= 0.85


def test_objects_are_nearer_to_the_truth_than_with_constant_velocity(result: Result) -> None:
    assert result.error <= 0.30 * result.constant


def test_permuted_labels_are_not_predicted(result: Result, contacts: NDArray[np.bool_]) -> None:
    """For n/2 contacts, the AUC of chance has the variance (n + 1) / (3 n^2)."""
    n = len(contacts)
    permuted = contacts[generator("permuted labels", 0).permutation(n)]
    auc = roc_auc_score(permuted, -result.gaps)
    assert abs(auc - 0.5) < 3 * np.sqrt((n + 1) / (3 * n * n))
