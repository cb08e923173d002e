"""Cues tell a property on which the answer to an otherwise equal test depends."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import physion
from physion import sample_scene
from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError, UnknownNameError
from physion.physics.engine import make_engine, simulate
from physion.physics.labels import label_contact
from physion.scenes.scene import Scene
from physion.trials.making.cues import CUT, FRAMES, VALUES, cue_tasks, four_scenes
from physion.trials.making.generate import GeneratedDataset
from physion.trials.making.plan import GenerateSettings
from physion.trials.making.verify import verify_dataset
from physion.trials.making.whatif import CUES

CONTACTS = {("far", 0), ("near", 1)}
"""Tests and values, the first or the second, in which agent and patient touch."""


def by_test_and_value(kind: str, name: str) -> dict[tuple[str, int], Scene]:
    scenes = four_scenes(replace(sample_scene("drop", 1), name=name), kind, make_engine())
    words = [str(scene.parameters["whatif"]).split(".") for scene in scenes]
    assert {word[0] for word in words} == {kind}
    return {
        (test, VALUES[kind].index(value)): scene
        for (_, test, value), scene in zip(words, scenes, strict=True)
    }


@pytest.mark.parametrize("kind", CUES)
def test_test_and_cue_tell_the_outcome_together_only(kind: str) -> None:
    scenes = by_test_and_value(kind, "drop_testing_0004")
    assert len(scenes) == 4
    motions = {key: simulate(scene) for key, scene in scenes.items()}
    for key, motion in motions.items():
        labels = label_contact(scenes[key], motion)
        assert labels.contact == (key in CONTACTS) and not labels.observed
        assert len(motion) == FRAMES
    for test in ("far", "near"):
        one, other = motions[test, 0], motions[test, 1]
        for name in ("positions", "rotations", "velocities", "angular_velocities"):
            first, second = getattr(one, name)[CUT:45], getattr(other, name)[CUT:45]
            np.testing.assert_array_equal(first, second)
        # The agent is body 0, and has gone 10 cm farther, or more, when the cue ends.
        ways = [np.linalg.norm(m.positions[CUT - 1, 0] - m.positions[0, 0]) for m in (one, other)]
        assert ways[0] > ways[1] + 0.1
        light, heavy = (scenes[test, value].bodies for value in (0, 1))
        assert light[1:] == heavy[1:]
        same = replace(heavy[0], mass=light[0].mass, contact=light[0].contact)
        assert light[0] == same and light[0] != heavy[0]
        assert (light[0].mass == heavy[0].mass) == (kind == "cue-friction")
        assert (light[0].contact == heavy[0].contact) == (kind == "cue-mass")
    # The cue does not tell the test either.
    for value in (0, 1):
        far, near = (motions[test, value].positions[:CUT, :2] for test in ("far", "near"))
        np.testing.assert_array_equal(far, near)


def test_names_do_not_tell_tests_and_values() -> None:
    engine, seen = make_engine(), set()
    for number in range(8):
        base = replace(sample_scene("drop", 1), name=f"drop_testing_{number:04d}")
        scenes = four_scenes(base, "cue-mass", engine)
        names = [f"{base.name}+cue-mass.{test}.{value}" for test in (0, 1) for value in (0, 1)]
        assert [scene.name for scene in scenes] == names
        seen.add(tuple(str(scene.parameters["whatif"]) for scene in scenes))
    assert len(seen) > 2, "an order that does not depend on the name"


def test_an_unknown_kind_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="cue-mass"):
        physion.generate(tmp_path / "trials", "drop", 1, whatif=["cue-weight"])
    assert not (tmp_path / "trials").exists()


@pytest.mark.slow
def test_cues_are_made_verified_and_kept(tmp_path: Path) -> None:
    settings = GenerateSettings(width=64, height=64, jitters=0, look="redyellow")

    def make() -> GeneratedDataset:
        return physion.generate(
            tmp_path / "trials", "collide", {"readout": 1}, whatif=["mass", *CUES],
            settings=settings, executor=SerialExecutor(),
        )  # fmt: skip

    dataset = make()
    index = dataset.index.set_index("trial")
    cued = [name for name in index.index if "+cue-" in name]
    assert len(cued) == 8 and len(index) == 1 + 2 + 8
    assert set(index["split"]) == {"readout"}
    assert index.loc[cued, "contact"].sum() == 4
    assert verify_dataset(tmp_path / "trials", again=3).faults == []
    for one, other in zip(cued[::2], cued[1::2], strict=True):
        shown = [dataset.trial(name).render(44).color for name in (one, other)]
        np.testing.assert_array_equal(*shown)
    (tmp_path / "trials" / "readout" / "collide" / f"{cued[0]}.h5").unlink()
    again = make()
    assert again.report.made == [cued[0]] and len(again.report.kept) == 10
    pd.testing.assert_frame_equal(again.index, dataset.index)
    with pytest.raises(BadInputError, match="is a variant"):
        cue_tasks(dataset, cued, CUES, "physion")
