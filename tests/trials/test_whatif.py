"""Variants of a scene differ in one thing, and are trials of the split of their trial."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest

import physion
from physion import sample_scene
from physion.cli.main import main
from physion.compute.local import SerialExecutor
from physion.core.errors import UnknownNameError
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.scenes.scene import Scene
from physion.trials.making.plan import GenerateSettings
from physion.trials.making.verify import verify_dataset
from physion.trials.making.whatif import KINDS, parts_of, variants

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
        assert after.static_friction == min(4 * before.static_friction, 1.0)
        assert after.dynamic_friction == min(4 * before.dynamic_friction, 1.0)
        assert after.restitution == before.restitution
    pushes = changed(scenario, "push")[1]
    assert set(pushes) == ({"weaker", "stronger"} if scene.pushes else set())
    for word, factor in (("weaker", 0.5), ("stronger", 1.5)) if scene.pushes else ():
        for old, new in zip(scene.pushes, pushes[word].pushes, strict=True):
            assert new == replace(old, impulse=tuple(factor * value for value in old.impulse))


def test_an_unknown_change_is_refused() -> None:
    with pytest.raises(UnknownNameError, match="push"):
        variants(sample_scene("drop", 1), ["pushes"])


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
