"""Error of imagined motion over time: closed forms, what counts, what is refused."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from physion.cli.main import main
from physion.clips.batch import Motion, Provenance, Spec
from physion.core.errors import BadInputError
from physion.models.particles.bodies import (
    Poses,
    Sampling,
    SceneParticles,
    poses_of,
    scene_particles,
)
from physion.readout.evaluate import evaluate
from physion.readout.rollout_error import COLUMNS, motion_error, rollout_error
from physion.readout.settings import EvaluationSettings
from physion.scenes.scene import BodyEvent
from physion.trials.dataset import Dataset
from support.viewer_dataset import FRAMES, PLANS, make_dataset, make_scene, make_trajectory

SPEED = 0.8 / (FRAMES - 1)
"""Metres a frame at which the ball of the hand-made trials falls, from frame 0 to the last, 59."""
STRIDE, NOW = 3, 14


def true_motion(plan: int = 0, **changes: Any) -> Motion:
    scene = make_scene(PLANS[plan])
    trajectory = make_trajectory(scene, PLANS[plan])
    # The mean of the ball's particles is not its pivot, and a rotation would move it.
    still = np.zeros_like(trajectory.rotations) + np.array([1, 0, 0, 0], np.float32)
    trajectory = dataclasses.replace(trajectory, rotations=still)
    return Motion(scene, dataclasses.replace(trajectory, **changes))


def start_of(motion: Motion, frames: Sequence[int]) -> tuple[SceneParticles, Poses]:
    particles = scene_particles(motion.scene, Sampling())
    return particles, poses_of(particles, motion, frames)


def standing_still(poses: Poses, rows: int) -> Poses:
    """A motion that stays as it is in its last row, for so many rows in all."""
    kept = np.minimum(np.arange(rows), NOW)
    return Poses(poses.centers[kept], poses.rotations[kept], poses.loose[kept])


class Standstill:
    """Model in which everything stays where it is."""

    spec = Spec(inputs=("state",), stride=STRIDE, context=NOW + 1, future=0, context_at="end")
    rows = 80

    def __init__(self) -> None:
        self.asked: list[Motion] = []

    def provenance(self) -> Provenance:
        return Provenance("standstill", "none")

    def digest(self) -> str:
        return "0" * 64

    def futures(
        self, motions: Sequence[Motion], samples: int, seed: int
    ) -> list[list[tuple[SceneParticles, Poses]]]:
        self.asked += motions
        results = []
        for motion in motions:
            particles, poses = start_of(motion, range(2, 45, STRIDE))
            results.append([(particles, standing_still(poses, self.rows))] * samples)
        return results


def test_constant_motion_has_no_error_by_constant_velocity_and_standing_still_a_linear_one() -> (
    None
):
    motion = true_motion()
    particles, poses = start_of(motion, range(2, 45, STRIDE))
    table = motion_error(motion, particles, standing_still(poses, 60), STRIDE, 105)
    assert table["frames"].tolist() == list(range(3, 106, 3))
    fallen = np.minimum(table["frames"], 15) * SPEED
    assert table["error"].to_numpy() == pytest.approx(fallen.to_numpy(), abs=1e-6)
    # After frame 59 the ball is at rest, and constant velocity goes on.
    beyond = (table["frames"] * SPEED - fallen).to_numpy()
    assert beyond[:5] == pytest.approx(0) and beyond[-1] == pytest.approx(90 * SPEED)
    assert table["constant_velocity_error"].to_numpy() == pytest.approx(beyond, abs=1e-5)


def test_errors_of_an_accelerated_motion_are_closed_forms() -> None:
    """A fall z = -a t^2 / 2 and an imagined one that is late by a step, in frames t."""
    a, late = 1e-4, STRIDE
    motion = true_motion()
    trajectory = motion.trajectory
    positions = trajectory.positions.copy()
    positions[:, 0, 2] = -a * np.arange(len(positions)) ** 2 / 2
    changed = Motion(motion.scene, dataclasses.replace(trajectory, positions=positions))
    particles, poses = start_of(changed, range(2, FRAMES, STRIDE))
    held = np.maximum(np.arange(len(poses.centers)) - (np.arange(len(poses.centers)) > NOW), 0)
    slow = Poses(poses.centers[held], poses.rotations[held], poses.loose[held])
    table = motion_error(changed, particles, slow, STRIDE, 15)
    t = 44 + np.arange(3, 16, 3)
    assert table["error"].to_numpy() == pytest.approx(a * (t**2 - (t - late) ** 2) / 2, rel=1e-3)
    # Constant velocity: the last observed step, from frame 41 to frame 44, goes on.
    step = a * (44**2 - 41**2) / 2
    constant = np.abs(a * t**2 / 2 - (a * 44**2 / 2 + step * np.arange(1, 6)))
    found = table["constant_velocity_error"].to_numpy()
    assert found == pytest.approx(constant, rel=1e-3, abs=1e-7)


def test_cloth_counts_by_the_mean_of_its_particles() -> None:
    motion = true_motion(3)
    particles, poses = start_of(motion, range(2, 45, STRIDE))
    table = motion_error(motion, particles, standing_still(poses, 60), STRIDE, 15)
    assert table["error"].to_numpy() == pytest.approx(np.arange(3, 16, 3) / (FRAMES - 1), abs=1e-6)
    assert table["constant_velocity_error"].to_numpy() == pytest.approx(0, abs=1e-5)


def test_the_truth_has_no_error_also_if_it_is_held_at_its_end() -> None:
    motion = true_motion()
    particles, poses = start_of(motion, range(2, FRAMES, STRIDE))
    table = motion_error(motion, particles, poses, STRIDE, 60)
    assert len(table) == 20 and table["error"].max() == pytest.approx(0, abs=1e-6)


def test_a_trial_that_was_cut_has_no_later_frames() -> None:
    motion = true_motion(completed=False)
    particles, poses = start_of(motion, range(2, 45, STRIDE))
    still = standing_still(poses, 60)
    assert motion_error(motion, particles, still, STRIDE, 105)["frames"].tolist() == [
        *(3, 6, 9, 12, 15)
    ]
    trajectory = motion.trajectory
    names = ("positions", "rotations", "velocities", "angular_velocities", "cloth_vertices")
    parts = {name: getattr(trajectory, name)[:45] for name in names}
    cut = Motion(motion.scene, dataclasses.replace(trajectory, **parts))
    assert motion_error(cut, particles, still, STRIDE, 105).empty


def test_objects_count_while_they_are_there_and_can_move() -> None:
    motion = true_motion()
    vanishing = dataclasses.replace(motion.scene, events=(BodyEvent(54, "ball", "vanish"),))
    particles, poses = start_of(motion, range(2, 45, STRIDE))
    still = standing_still(poses, 60)
    gone = motion_error(Motion(vanishing, motion.trajectory), particles, still, STRIDE, 105)
    assert gone["frames"].tolist() == [3, 6, 9]
    bodies = tuple(dataclasses.replace(body, kinematic=True) for body in motion.scene.bodies)
    fixed = dataclasses.replace(motion.scene, bodies=bodies)
    particles = scene_particles(fixed, Sampling())
    assert motion_error(Motion(fixed, motion.trajectory), particles, still, STRIDE, 105).empty


@pytest.fixture(scope="module")
def dataset(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    return Dataset(make_dataset(tmp_path_factory.mktemp("data") / "set"))


def test_errors_of_a_dataset_come_only_from_the_observed_part(dataset: Dataset) -> None:
    model = Standstill()
    table = rollout_error(dataset, model, ["drop_0", "drape_0"], horizon=15)
    assert tuple(table.columns) == COLUMNS and len(table) == 10
    assert set(table["model"]) == {"standstill"} and table["scenario"][9] == "drape"
    assert table["error"][4] == pytest.approx(15 * SPEED, abs=1e-4)
    assert [len(motion.trajectory) for motion in model.asked] == [45, 45]


def test_what_cannot_have_an_error_is_refused(
    dataset: Dataset, capsys: pytest.CaptureFixture[str]
) -> None:
    class Lost(Standstill):
        def futures(self, *rest: Any) -> Any:
            results = super().futures(*rest)
            results[0][0][1].centers[30] = np.nan
            return results

    with pytest.raises(BadInputError, match="trial 'drop_0': positions that are not finite"):
        rollout_error(dataset, Lost(), ["drop_0"])
    command = f"evaluate constant-motion {dataset.folder} --option rollout_errors=true"
    assert main(command.split()) == 2
    assert "imagines no motion of objects" in capsys.readouterr().err
    with pytest.raises(BadInputError, match=r"imagines no motion of objects.*such as dpi"):
        evaluate("constant-motion", dataset, "nowhere", rollout_errors=True)


@pytest.mark.nightly
@pytest.mark.slow
def test_evaluate_writes_them_next_to_the_predictions(dataset: Dataset, tmp_path: Path) -> None:
    config = EvaluationSettings(untrained=True, folds=2, accelerator="cpu")
    result = evaluate("dpi", dataset, tmp_path, settings=config, rollout_errors=True)
    errors = result.evaluated[0].rollout_errors
    assert errors == tmp_path / "rollout-errors" / result.paths[0].name
    written = pd.read_csv(errors)
    assert tuple(written.columns) == COLUMNS and set(written["model"]) == {"dpi-small"}
    assert sorted(set(written["stimulus"])) == sorted(result.predictions["stimulus"])
    first = written[(written["stimulus"] == "drop_1") & (written["frames"] <= 15)]
    assert len(first) == 5 and first["constant_velocity_error"].max() < 1e-3
    before = errors.stat().st_mtime_ns
    again = evaluate("dpi", dataset, tmp_path, settings=config, rollout_errors=True)
    assert again.evaluated[0].rollout_errors == errors
    assert errors.stat().st_mtime_ns == before
