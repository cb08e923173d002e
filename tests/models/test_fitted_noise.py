"""Levels of noise that were fitted to outcomes and to people, and the models that use them."""

from __future__ import annotations

import dataclasses
import re
from dataclasses import replace

import numpy as np
import pytest

from physion.core.errors import BadInputError, UnknownNameError
from physion.data.official import official
from physion.models import Batch, Motion, build_model
from physion.models.noisy_simulation import FITTED, configuration_half, fitted_levels
from physion.models.state_noise import NoiseLevels
from physion.physics.engine import simulate
from physion.scenes.scene import Scene
from support.paths import ROOT


def scene_of(half: int) -> Scene:
    """An official scene of Collide without contact in the observed part, of a half."""
    return next(
        trial.scene
        for trial in official().trials
        if trial.scene.scenario == "collide"
        and not trial.outcome.contact
        and configuration_half(trial.scene) == half
    )


def test_scenes_of_a_configuration_are_in_one_half_and_both_halves_are_used() -> None:
    halves: dict[object, set[int]] = {}
    for trial in official().trials:
        name = trial.scene.parameters["configuration"]
        halves.setdefault(name, set()).add(configuration_half(trial.scene))
    assert all(len(found) == 1 for found in halves.values())
    counts = [sum(found == {half} for found in halves.values()) for half in (0, 1)]
    assert min(counts) > len(halves) / 3


@pytest.mark.parametrize("half", [0, 1])
def test_levels_are_those_fitted_on_the_other_half(half: int) -> None:
    for target, levels in FITTED.items():
        assert fitted_levels(target, scene_of(half)) == levels[1 - half]


@pytest.mark.parametrize("half", [0, 1])
def test_the_model_simulates_with_these_levels(half: int) -> None:
    scene = scene_of(half)
    levels = dataclasses.asdict(FITTED["people"][1 - half])
    motion = Motion(scene, simulate(scene, frames=45))
    frames, valid = np.array([[44]]), np.ones((1, 1), np.bool_)
    batch = Batch((scene.name,), frames, valid, state=(motion,))
    fitted = build_model("noisy-simulation-people").imagine(batch, 20, 0)
    given = build_model("noisy-simulation", **levels).imagine(batch, 20, 0)
    assert np.array_equal(fitted.contact, given.contact)


def test_the_table_of_predictions_says_what_the_noise_was_fitted_to() -> None:
    names = {build_model(f"noisy-simulation-{name}").provenance() for name in FITTED}
    assert {p.model for p in names} == {"noisy-simulation-outcomes", "noisy-simulation-people"}
    assert all(p.dynamics_training_task.startswith("noise fitted to") for p in names)
    assert build_model("noisy-simulation").provenance().dynamics_training_task == ""


def test_fitted_levels_have_digests_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    names = ("noisy-simulation", *(f"noisy-simulation-{name}" for name in FITTED))
    digests = {build_model(name).digest() for name in names}
    assert len(digests) == 3
    other = {**FITTED, "people": (FITTED["people"][0], NoiseLevels(velocity=9.0))}
    monkeypatch.setattr("physion.models.noisy_simulation.FITTED", other)
    assert build_model("noisy-simulation-people").digest() not in digests


def test_nothing_is_fitted_to_the_trials_at_hand() -> None:
    assert build_model("noisy-simulation-people").knobs == {"scale": (1.0,)}
    assert build_model("noisy-simulation").knobs == {"scale": (0.5, 1.0, 2.0)}


def test_levels_are_fitted_or_given() -> None:
    with pytest.raises(BadInputError, match="is fitted: leave out velocity"):
        build_model("noisy-simulation-people", velocity=0.3)
    with pytest.raises(UnknownNameError, match="'noisy-simulation-persons'"):
        build_model("noisy-simulation-persons")


def test_a_scene_without_a_configuration_counts_by_its_name() -> None:
    scene = replace(scene_of(0), parameters={})
    halves = {configuration_half(replace(scene, name=f"scene {i}")) for i in range(20)}
    assert halves == {0, 1}


def test_levels_are_those_that_the_benchmark_printed() -> None:
    text = (ROOT / "benchmarks" / "results" / "noise.md").read_text()
    for target, fitted in FITTED.items():
        for half, levels in enumerate(fitted):
            cell = re.findall(rf"^\| {target} \| {half} \| ([^|]*) \|", text, re.MULTILINE)[-1]
            listed, _, lapse = cell.partition("; lapse ")
            values = dict(part.split() for part in listed.split(", "))
            known = {field.name: 0.0 for field in dataclasses.fields(NoiseLevels)}
            known |= {name: float(value) for name, value in values.items()}
            assert dataclasses.asdict(levels) == {**known, "lapse": float(lapse)}
