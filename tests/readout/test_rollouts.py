"""Imagined outcomes: groups of trials, trials that fail, and networks in processes."""

from __future__ import annotations

import pickle
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from physion import sample_scene
from physion.clips.batch import Batch, Motion, Rollout, Spec, cut_to_observed
from physion.compute.local import LocalExecutor, SerialExecutor
from physion.core.errors import BadInputError
from physion.models.build import build_model
from physion.physics.engine import simulate
from physion.readout.features import RolloutStore
from physion.scenes.scene import Ending


class Source:
    """Source of some motions; trials named ``bad...`` cannot be read."""

    def __init__(self, trials: Sequence[str], motions: Sequence[Motion] = ()) -> None:
        self.motions = dict(zip(trials, motions, strict=False))

    def key(self, trial: str, part: str) -> str:
        return f"{trial} {part}"

    def context(self, trials: Sequence[str]) -> Batch:
        for trial in trials:
            if trial.startswith("bad"):
                raise BadInputError(f"{trial} is damaged")
        frames = np.arange(2, 45, 3)[None].repeat(len(trials), 0)
        state = tuple(self.motions[trial] for trial in trials) if self.motions else None
        return Batch(tuple(trials), frames, np.ones_like(frames, np.bool_), state=state)


class Counts:
    """Model that gives the length of a name as its gap, and fails for ``odd...``."""

    spec = Spec(inputs=("state",), future=0)

    def __init__(self) -> None:
        self.sizes: list[int] = []

    def digest(self) -> str:
        return "0" * 64

    def provenance(self) -> Any:
        return SimpleNamespace(model="counts")

    def imagine(self, context: Batch, samples: int, seed: int, **knobs: float) -> Rollout:
        self.sizes.append(len(context))
        if any(trial.startswith("odd") for trial in context.trials):
            raise BadInputError("an odd trial")
        gaps = np.array([[float(len(trial))] * samples for trial in context.trials])
        return Rollout(gap=gaps * knobs.get("factor", 1.0))


def test_trials_that_fail_cost_no_other_trial() -> None:
    names = ["a", "bb", "bad", "ccc", "odd", "dddd"]
    store, model = RolloutStore(None, SerialExecutor()), Counts()
    source: Any = Source(names)
    found = store.outcomes(
        model, source, names, samples=1, seed=0, knobs={"factor": (1.0, 2.0)}, together=3
    )
    for factor in (1, 2):
        cells = found[(("factor", float(factor)),)]
        assert {trial: cell[1] for trial, cell in cells.items()} == {
            trial: [float(len(trial) * factor)] for trial in ("a", "bb", "ccc", "dddd")
        }
    assert store.problems == {"bad": "bad is damaged", "odd": "an odd trial"}
    assert max(model.sizes) == 3 and 1 in model.sizes


@pytest.mark.parametrize("name", ["gns", "gns-ransac", "dpi"])
@pytest.mark.parametrize("weights", ["random", "shipped"])
def test_a_pickled_particle_model_is_the_same(name: str, weights: str) -> None:
    model: Any = build_model(name, weights=weights, seed=3, samples=2)
    again = pickle.loads(pickle.dumps(model))
    assert again.digest() == model.digest() and again.provenance() == model.provenance()
    assert (again.trained, again.samples, again.decision) == (
        model.trained, model.samples, model.decision,
    )  # fmt: skip


@pytest.mark.slow
def test_particle_models_imagine_the_same_in_processes() -> None:
    motions = []
    for seed in range(3):
        scene = replace(sample_scene("collide", seed), ending=Ending(60, 60))
        motions.append(Motion(scene, cut_to_observed(scene, simulate(scene))))
    names = [f"trial_{row}" for row in range(3)]
    source: Any = Source(names, motions)
    model: Any = build_model("dpi")
    assert model.trials_together > 1
    found = [
        RolloutStore(None, executor).outcomes(
            model, source, names, samples=1, seed=0, knobs={}, together=2
        )[()]
        for executor in (SerialExecutor(), LocalExecutor(2))
    ]
    assert found[0].keys() == set(names)
    for name in names:
        assert found[0][name][1] == pytest.approx(found[1][name][1], abs=1e-6)
