"""Variants of a scene differ in one thing; cues tell on what an equal test depends."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import physion
from physion import sample_scene
from physion.cli.main import main
from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError, UnknownNameError
from physion.physics.engine import make_engine, simulate
from physion.physics.labels import label_contact
from physion.scenes.scene import Scene
from physion.trials.making.cues import CUT, FRAMES, VALUES, cue_tasks, four_scenes
from physion.trials.making.generate import GeneratedDataset
from physion.trials.making.plan import GenerateSettings
from physion.trials.making.verify import verify_dataset
from physion.trials.making.whatif import CUES, KINDS, parts_of, variants

SCENARIOS = ("collide", "contain", "dominoes", "drape", "drop", "link", "roll", "support")


def changed(scenario: str, kind: str) -> tuple[Scene, dict[str, Scene]]:
    scene = sample_scene(scenario, 1)
    return scene, {change.partition(".")[2]: one for change, one in variants(scene, [kind])}


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_every_other_body_is_removed_once(scenario: str) -> None:
    scene, found = changed(scenario, "remove")
    roles = (scene.roles.agent, scene.roles.patient)
    others = [b.name for b in scene.bodies if not b.scenery and b.name not in roles]
    assert list(found) == others
    for name, one in found.items():
        assert set(scene.names()) - set(one.names()) == {name}
        kept = [body for body in scene.bodies if body.name != name]
        assert list(one.bodies) == kept and one.cloths == scene.cloths
        assert all(push.body != name for push in one.pushes)
        assert all(name not in (joint.parent, joint.child) for joint in one.joints)
        assert len(simulate(one, frames=3)) == 3


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_mass_friction_and_push_are_changed_and_nothing_else(scenario: str) -> None:
    scene, heavier = changed(scenario, "mass")
    things = {thing.name: thing for thing in (*scene.bodies, *scene.cloths)}
    agent = things[scene.roles.agent]
    for word, factor in (("quarter", 0.25), ("fourfold", 4.0)):
        one = heavier[word]
        (new,) = (t for t in (*one.bodies, *one.cloths) if t.name == agent.name)
        assert new == replace(agent, mass=agent.mass * factor)
        assert [t for t in (*one.bodies, *one.cloths) if t is not new] == [
            t for t in things.values() if t is not agent
        ]
    rough = changed(scenario, "friction")[1]
    for old, new in zip(scene.bodies, rough["fourfold"].bodies, strict=True):
        before, after = old.contact, new.contact
        if old.scenery:
            assert before == after
            continue
        for old, new in (
            (before.static_friction, after.static_friction),
            (before.dynamic_friction, after.dynamic_friction),
        ):
            assert new == min(4 * old, max(old, 1.0)) >= old  # also where it is above 1
        assert after.restitution == before.restitution
    pushes = changed(scenario, "push")[1]
    assert set(pushes) == ({"weaker", "stronger"} if scene.pushes else set())
    for word, factor in (("weaker", 0.5), ("stronger", 1.5)) if scene.pushes else ():
        for old, new in zip(scene.pushes, pushes[word].pushes, strict=True):
            assert new == replace(old, impulse=tuple(factor * value for value in old.impulse))


def test_an_unknown_change_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="push"):
        variants(sample_scene("drop", 1), ["pushes"])
    with pytest.raises(UnknownNameError, match="cue-mass"):
        physion.generate(tmp_path / "trials", "drop", 1, whatif=["cue-weight"])
    assert not (tmp_path / "trials").exists()


@pytest.mark.slow
def test_variants_are_made_with_the_trials(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = GenerateSettings(width=64, height=64, jitters=0, movies=False)

    def make(count: int) -> physion.Dataset:
        return physion.generate(
            tmp_path / "trials", "collide", count, whatif=KINDS, settings=settings,
            executor=SerialExecutor(),
        )  # fmt: skip

    dataset = make(2)
    names = dataset.trials()
    bases = [name for name in names if "+" not in name]
    assert bases == ["collide_testing_0000", "collide_testing_0001"]
    for base in bases:
        own = [name for name in names if parts_of(name)[0] == base and name != base]
        scene = dataset.trial(base).scene
        assert len(own) == len(variants(scene)) >= 7
        for name in own:
            trial = dataset.trial(name)
            known = trial.scene.parameters
            change = dict(variants(scene))[known["whatif"]]
            assert trial.scene.physics_digest() == change.physics_digest()
            contact = label_contact(change, simulate(change)).contact
            assert trial.known_labels().contact == contact
            assert known["base_contact"] == dataset.trial(base).known_labels().contact
            assert trial.metadata.split == "testing"
    assert verify_dataset(tmp_path / "trials", again=4).faults == []
    out = tmp_path / "out"
    assert main(["evaluate", "constant-motion", str(dataset.folder), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    table = pd.read_csv(out / "causes.csv")
    assert len(table) and f"of {len(table)} removals change the outcome: " in printed
    labels = dataset.index.set_index("trial")["contact"]
    for row in table.itertuples():
        without = labels[f"{row.trial}+remove.{row.removed}"]
        assert (row.before, row.after) == (labels[row.trial], without)
        assert row.changed == (row.before != row.after)
    digests = dict(zip(dataset.index["trial"], dataset.index["trial_file_sha256"], strict=True))
    again = make(3)
    more = dict(zip(again.index["trial"], again.index["trial_file_sha256"], strict=True))
    assert len(more) > len(digests) and digests.items() <= more.items(), "nothing changes"


# --- cues -----------------------------------------------------------------------------------------


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
