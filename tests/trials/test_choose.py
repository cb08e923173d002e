"""Choice of scenes: balance, no early contact, robustness, visibility, no duplicates."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError, BadSceneError, PhysionError
from physion.core.seeds import trial_seed
from physion.physics.engine import simulate
from physion.physics.labels import label_contact
from physion.rendering.renderer import Renderer
from physion.scenes.sampling.sample import sample_scene
from physion.scenes.scene import Scene
from physion.trials.dataset import Dataset
from physion.trials.making import choose as choosing
from physion.trials.making.choose import (
    choose,
    judge,
    robustness,
    split_of,
    wanted_contact,
)
from physion.trials.making.generate import make_trials
from physion.trials.making.make import scene_of
from physion.trials.making.plan import (
    SPLITS,
    GenerateJob,
    GenerateSettings,
    TrialTask,
    plan_dataset,
)
from support.hand_made import tree_digest

QUICK = GenerateSettings(width=64, height=64, jitters=0, min_visible=0.0, movies=False)


def slots(split: str, count: int, scenario: str = "collide") -> list[TrialTask]:
    return plan_dataset("choose", [scenario], {split: count}, {scenario: ["default"]})


def test_half_of_the_slots_want_contact_in_an_order_that_gives_nothing_away() -> None:
    for split in ("readout", "testing", "familiarization"):
        wanted = [wanted_contact(task) for task in slots(split, 150)]
        assert wanted.count(True) == wanted.count(False) == 75
        odd = wanted[::2].count(True)
        assert 20 < odd < 55, "neither even nor odd numbers tell the answer"
    assert {wanted_contact(task) for task in slots("training", 10)} == {None}


def test_every_physics_belongs_to_one_split() -> None:
    """Eight sixteenths train, four fit the readout, three test, one is for practice."""
    splits = [split_of(f"1234567{digit:x}" + "0" * 56) for digit in range(16)]
    counts = {"training": 8, "readout": 4, "testing": 3, "familiarization": 1}
    assert splits == [name for name, count in counts.items() for _ in range(count)]
    scene = sample_scene("collide", trial_seed("c", "collide", "x", 0))
    renamed = dataclasses.replace(scene, name="other", room="bright")
    assert renamed.physics_digest() == scene.physics_digest()


@pytest.mark.parametrize("split", ["testing", "training"])
def test_chosen_draws_are_what_their_split_takes(split: str, tmp_path: Path) -> None:
    contacts = []
    for task in slots(split, 6):
        filled, scene = choose(GenerateJob(task, tmp_path, QUICK))
        assert scene == scene_of(filled) and scene.name == task.trial
        assert split_of(scene.physics_digest()) == split
        labels = label_contact(scene, simulate(scene))
        contacts.append(labels.contact)
        if split == "testing":
            assert labels.contact == wanted_contact(task)
            assert not labels.observed
    if split == "testing":
        assert sum(contacts) == 3


def few_scenes(monkeypatch: pytest.MonkeyPatch, count: int) -> None:
    """Let every draw be one of ``count`` scenes, as presets without chance do."""
    real = choosing.sample_scene

    def draw(name: str, seed: object, params: object = None) -> object:
        number = int(seed.entropy % count)  # type: ignore[attr-defined]
        return real(name, trial_seed("few", name, "x", number), params)

    monkeypatch.setattr(choosing, "sample_scene", draw)


@pytest.mark.slow
def test_copies_are_refused_and_scarce_physics_is_said(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    few_scenes(monkeypatch, 6)
    monkeypatch.setattr(choosing, "MAX_TRIES", 5)
    monkeypatch.setattr(choosing, "MAX_ELSEWHERE", 60)
    settings = dataclasses.replace(QUICK, width=32, height=32)
    report = make_trials(tmp_path, slots("training", 6), settings, executor=SerialExecutor())
    digests = Dataset(tmp_path).index["scene_digest"]
    assert digests.is_unique and len(digests) == len(report.made) > 1
    assert report.failed, "six scenes, of which some belong to other splits, cannot fill six"
    for reason in report.failed.values():
        assert "another trial has the same physics: 5" in reason


@pytest.mark.slow
def test_scenes_do_not_depend_on_order_or_on_what_else_is_asked(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    few_scenes(monkeypatch, 40)  # so that some find the same physics at first
    tasks, folders = slots("training", 6), [tmp_path / name for name in "abc"]
    make_trials(folders[0], tasks, QUICK, executor=SerialExecutor())
    make_trials(folders[1], tasks[::-1], QUICK, executor=SerialExecutor())
    make_trials(folders[2], tasks[:2], QUICK, executor=SerialExecutor())
    make_trials(folders[2], tasks, QUICK, executor=SerialExecutor())
    assert len({tree_digest(folder) for folder in folders}) == 1


def test_reasons_are_counted_and_settings_are_heeded() -> None:
    task = slots("testing", 1)[0]
    wants = wanted_contact(task)
    seen, robust = {}, []
    for index in range(60):
        seed = trial_seed("reasons", "collide", "x", index)
        scene = sample_scene("collide", seed)
        reason, _ = judge(scene, seed, task, QUICK)
        seen.setdefault(reason, (scene, seed))
        if reason is None and len(robust) < 3:
            robust.append(robustness(scene, bool(wants), seed, 8))
    assert None in seen and ("no contact" if wants else "contact") in seen
    assert all(share * 8 == int(share * 8) and 0 <= share <= 1 for share in robust)
    scene, seed = seen[None]
    hidden = dataclasses.replace(QUICK, min_visible=0.9)
    assert (
        judge(scene, seed, task, hidden)[0] == "agent or patient hardly visible in the first frame"
    )
    picky = dataclasses.replace(QUICK, jitters=8, robust=1.0)
    reason, share = judge(scene, seed, task, picky)
    assert (reason, share) == (None, 1.0) or reason == "outcome not robust"
    early = seen.get("contact inside the observed part")
    if wants:
        assert early, "of 60 draws of collide some touch early"
        official = dataclasses.replace(QUICK, observed_contact=True)
        assert judge(*early, task, official)[0] is None


def test_agent_and_patient_must_each_be_visible() -> None:
    """Both fractions are counted here, in a picture of their own."""
    task = TrialTask("choose", "collide", "training", 0)
    seed = trial_seed("reasons", "collide", "x", 1)
    scene = sample_scene("collide", seed)
    ids = Renderer(scene, simulate(scene, frames=1), 64, 64).render(0, ("ids",)).ids
    roles = (scene.roles.agent, scene.roles.patient)
    fractions = sorted((ids == scene.index(name) + 1).mean() for name in roles)
    assert 0 < fractions[0] < fractions[1]
    for least, visible in (
        (fractions[0], True),
        (fractions[0] + 1e-6, False),
        (fractions[1], False),
    ):
        reason, _ = judge(scene, seed, task, dataclasses.replace(QUICK, min_visible=least))
        assert (reason is None) == visible


def test_robustness_counts_the_runs_that_agree() -> None:
    seed = trial_seed("robust", "collide", "x", 0)
    scene = sample_scene("collide", seed)
    contact = label_contact(scene, simulate(scene)).contact
    share = robustness(scene, contact, seed, 8)
    assert robustness(scene, not contact, seed, 8) == pytest.approx(1 - share)
    assert share >= 0.5


def test_every_run_of_the_robustness_has_a_noise_of_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of 1 mm: with one noise for all runs, or another seed, a trial would look too robust."""
    seen: list[Scene] = []
    real = choosing.simulate_many

    def noted(scenes: list[Scene], **options: object) -> object:
        seen.extend(scenes)
        return real(scenes[:1], **options) * len(scenes)  # type: ignore[arg-type]

    monkeypatch.setattr(choosing, "simulate_many", noted)
    seed, other = (trial_seed("robust", "dominoes", "x", index) for index in (0, 1))
    scene = sample_scene("dominoes", seed)
    for one in (seed, seed, other):
        robustness(scene, True, one, 12)
    free = [row for row, body in enumerate(scene.bodies) if not (body.kinematic or body.scenery)]
    start = np.array([body.position for body in scene.bodies])[free]
    moved = np.array([[body.position for body in run.bodies] for run in seen])[:, free] - start
    first, again, others = moved.reshape(3, 12, -1)
    assert (first == again).all()
    runs = np.concatenate([first, others])
    assert len(np.unique(runs.round(9), axis=0)) == 24, "no noise occurs twice"
    noise = runs[runs != 0]
    assert noise.std() == pytest.approx(0.001, rel=4 / np.sqrt(2 * noise.size))


def test_a_preset_that_hardly_varies_or_cannot_be_used_is_given_up(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    task = slots("testing", 1)[0]
    with monkeypatch.context() as patch:
        patch.setattr(choosing, "MAX_TRIES", 4)
        said = r"none of 4 scenes sampled from default is accepted \("
        with pytest.raises(PhysionError, match=said):
            choose(GenerateJob(task, Path(), dataclasses.replace(QUICK, min_visible=0.99)))

    def refuse(*_: object) -> object:
        raise BadSceneError("ball could not be placed in 100 tries: it meets the wall (100)")

    with monkeypatch.context() as patch:
        patch.setattr(choosing, "sample_scene", refuse)
        said = r"none of 20 scenes .*it meets the wall \(100\): 20"
        with pytest.raises(PhysionError, match=said):
            choose(GenerateJob(task, Path(), QUICK))
    few_scenes(monkeypatch, 1)
    monkeypatch.setattr(choosing, "MAX_ELSEWHERE", 8)
    digest = sample_scene("collide", trial_seed("few", "collide", "x", 0)).physics_digest()
    other = next(split for split in SPLITS if split != split_of(digest))
    with pytest.raises(PhysionError, match="default hardly varies"):
        choose(GenerateJob(slots(other, 1)[0], Path(), QUICK))


def test_a_dataset_of_only_states(tmp_path: Path) -> None:
    settings = GenerateSettings(width=64, height=64, movies=False, jitters=2, playback="real")
    tasks = slots("readout", 2)
    report = make_trials(tmp_path / "d", tasks, settings, executor=SerialExecutor())
    assert not report.failed
    index = Dataset(tmp_path / "d").index
    assert sorted(index["contact"]) == [False, True]
    assert index["movie"].isna().all() and index["robust"].isin([0.0, 0.5, 1.0]).all()
    assert (index["physics_seconds"] == (index["frames"] - 1) * 0.01).all()
    assert (index["playback_seconds"] == index["frames"] / 100).all()
    other = plan_dataset("choose", ["collide"], {"readout": 2}, {"collide": ["debug"]})
    with pytest.raises(BadInputError, match="readout/collide"):
        make_trials(tmp_path / "d", other, settings, executor=SerialExecutor())
