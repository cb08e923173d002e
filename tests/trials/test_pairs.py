"""Pairs of movies: alike up to a frame, each beginning and each end once possible, once not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import physion
from physion import sample_scene
from physion.compute.local import SerialExecutor
from physion.core.errors import BadInputError, UnknownNameError
from physion.physics.engine import make_engine, simulate
from physion.physics.trajectory import Trajectory
from physion.rendering.renderer import Renderer
from physion.scenes.looks import in_look
from physion.scenes.scene import Scene
from physion.trials.dataset import Dataset
from physion.trials.making.make import make_movies
from physion.trials.making.pairs import (
    KINDS,
    RISE,
    SCREEN,
    SHELF,
    Pair,
    Quadruple,
    four_scenes,
    is_pair,
    motion_of,
    quadruple,
)
from physion.trials.making.plan import GenerateSettings
from physion.trials.making.verify import verify_dataset
from physion.trials.video import read_chosen

EXAMPLES = {
    "vanish": ("dominoes", 0),
    "teleport": ("collide", 0),
    "swap": ("dominoes", 1),
    "stop-in-air": ("drop", 4),
    "pass-through": ("collide", 2),
}
"""A scene that allows pairs of each kind."""


@cache
def found(kind: str) -> tuple[Quadruple, int]:
    scenario, seed = EXAMPLES[kind]
    for number in range(seed, seed + 20):
        scene = replace(sample_scene(scenario, number), name=f"{scenario}_testing_{number:04d}")
        path = simulate(scene)
        if (one := quadruple(scene, path, kind, make_engine())) is not None:
            return one, len(path)
    raise AssertionError(f"no scene of {scenario} allows {kind}")


@cache
def four(kind: str, base: str) -> dict[tuple[int, int], tuple[Scene, Trajectory]]:
    one, frames = found(kind)
    parts = {}
    for scene in four_scenes(one, base, frames, make_engine()):
        pair = Pair.of(scene)
        assert pair is not None
        parts[pair.first, pair.then] = scene, motion_of(scene, make_engine())
    assert sorted(parts) == [(0, 0), (0, 1), (1, 0), (1, 1)]
    return parts


def base_with(kind: str, *, hidden: bool) -> str:
    """Return the name of a base whose quadruple has a screen, or none."""
    one, frames = found(kind)
    for number in range(40):
        scenes = four_scenes(one, f"base_{number}", frames, make_engine())
        if (SCREEN in scenes[0].names()) == hidden:
            return f"base_{number}"
    raise AssertionError(f"no base of {kind} with hidden={hidden}")


@pytest.mark.parametrize("kind", KINDS)
def test_possible_movies_show_one_world_and_impossible_ones_change(kind: str) -> None:
    one, frames = found(kind)
    worlds = [simulate(world, frames=frames) for world in one.worlds]
    parts = four(kind, base_with(kind, hidden=False))
    bodies = len(one.worlds[0].bodies)
    for (first, then), (scene, path) in parts.items():
        pair = Pair.of(scene)
        assert pair is not None and pair.possible == (first == then) and not pair.hidden
        assert len(path) == frames and len(scene.bodies) == bodies
        before, after = worlds[first].positions, worlds[then].positions
        assert np.array_equal(path.positions[: one.start], before[: one.start])
        row = scene.index(one.body)
        if scene.present(frames - 1)[row] and one.worlds[then].present(frames - 1)[row]:
            assert np.array_equal(path.positions[one.start :, row], after[one.start :, row])
    # All else is alike in both worlds up to the change.
    watched = {one.body, SHELF}
    others = [
        row for row, body in enumerate(one.worlds[0].bodies)
        if body.name not in watched and not body.scenery
    ]  # fmt: skip
    if kind not in ("swap", "pass-through"):
        apart = np.abs(worlds[0].positions - worlds[1].positions)[: one.start, others]
        assert apart.max(initial=0) <= 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_pictures_are_equal_up_to_the_change_and_no_further(kind: str) -> None:
    start = found(kind)[0].start
    parts = four(kind, base_with(kind, hidden=False))
    for first in (0, 1):
        same, changed = (
            Renderer(in_look(parts[first, then][0], "redyellow"), parts[first, then][1], 64, 64)
            for then in (first, 1 - first)
        )

        def equal(frame: int, one: Renderer = same, other: Renderer = changed) -> bool:
            colors = [np.asarray(each.render(frame).color) for each in (one, other)]
            return bool((colors[0] == colors[1]).all())

        assert all(equal(frame) for frame in (0, start - RISE, start - 1))
        assert not all(equal(frame) for frame in (start, start + 10, start + 20))


def test_a_body_vanishes_and_appears() -> None:
    start, body = found("vanish")[0].start, found("vanish")[0].body
    there = {
        part: [
            scene.present(frame)[scene.index(body)] for frame in (0, start - 1, start, start + 30)
        ]
        for part, (scene, _) in four("vanish", "base_0").items()
    }
    assert there[0, 0] == [True] * 4 and there[1, 1] == [False] * 4
    assert there[0, 1] == [True, True, False, False]
    assert there[1, 0] == [False, False, True, True]


@pytest.mark.parametrize("kind", ["teleport", "swap"])
def test_a_body_jumps_at_the_change_and_only_there(kind: str) -> None:
    one, _ = found(kind)
    scene, path = four(kind, "base_0")[0, 1]
    steps = np.abs(np.diff(path.positions[:, scene.index(one.body)], axis=0)).max(axis=1)
    assert steps[one.start - 1] > 0.15
    assert np.delete(steps, one.start - 1).max() < 0.1


def test_a_falling_body_stops_where_no_shelf_is_and_falls_through_one() -> None:
    one, frames = found("stop-in-air")
    parts = four("stop-in-air", "base_0")
    for (first, then), (scene, path) in parts.items():
        assert scene.present(frames - 1)[scene.index(SHELF)] == (first == 1)
        height = path.positions[:, scene.index(one.body), 2]
        fallen = height[one.start] - height[one.start : one.start + 20].min()
        # With g = 9.81 m/s^2, 19 frames from 0.5 m/s are at least 0.09 m more than any bounce.
        assert (fallen > 0.1) == (then == 0)


def test_what_is_passed_through_stays_where_it_was() -> None:
    one, frames = found("pass-through")
    (lacks,) = [
        row for row, there in enumerate(one.worlds[1].present(frames - 1)) if not there
    ]  # fmt: skip
    scene, path = four("pass-through", "base_0")[0, 1]
    later = path.positions[one.start - 1 :, lacks]
    assert np.array_equal(later, np.broadcast_to(later[0], later.shape))
    # Deflected by nothing: the other body is not in the picture, and X moves as if it were.
    scene, path = four("pass-through", "base_0")[1, 0]
    assert not any(scene.present(frame)[lacks] for frame in (0, one.start, frames - 1))
    hit = simulate(one.worlds[0], frames=frames)
    row = scene.index(one.body)
    assert np.array_equal(path.positions[one.start :, row], hit.positions[one.start :, row])


def test_a_screen_hides_the_body_at_the_change() -> None:
    one, _ = found("vanish")
    parts = four("vanish", base_with("vanish", hidden=True))
    scene, path = parts[0, 0]
    renderer, row = Renderer(scene, path, 96, 96), scene.index(one.body)

    def seen(frame: int) -> int:
        ids = renderer.render(frame, ("ids",)).ids
        assert ids is not None
        return int((ids == row + 1).sum())

    assert seen(one.start - RISE) > 0
    assert [seen(one.start + step) for step in (-2, 0, 6, 12)] == [0, 0, 0, 0]
    # All four have the same screen, which no engine moves.
    moves = {
        tuple(event for event in scene.events if event.body == SCREEN)
        for scene, _ in parts.values()
    }  # fmt: skip
    assert len(moves) == 1 and len(moves.pop()) > 0


def test_the_order_of_names_does_not_tell_which_are_possible() -> None:
    one, frames = found("swap")
    counts = np.zeros(4)
    for number in range(40):
        scenes = four_scenes(replace(one, kind="vanish"), f"n{number}", frames, make_engine())
        counts += [Pair.of(scene).possible for scene in scenes]  # type: ignore[union-attr]
    assert counts.sum() == 80 and counts.min() >= 10


def test_cloth_has_no_pairs_and_kinds_are_known() -> None:
    path = simulate(sample_scene("drop", 0), frames=100)
    assert quadruple(sample_scene("drape", 0), path, "vanish", make_engine()) is None
    with pytest.raises(UnknownNameError, match="teleport"):
        physion.generate("unused", "drop", 1, pairs=["teleprot"])


def test_what_was_asked_for_and_not_made_is_said(tmp_path: Path) -> None:
    settings = GenerateSettings(width=32, height=32, jitters=0, movies=False)

    def make(split: str) -> physion.trials.making.generate.GeneratedDataset:
        return physion.generate(
            tmp_path, "dominoes", {split: 1}, pairs=["vanish", "stop-in-air"], settings=settings,
            executor=SerialExecutor(),
        )  # fmt: skip

    assert make("testing").report.notes == {"pairs of stop-in-air": ("no trial allows them",)}
    with pytest.raises(BadInputError, match="there are none: --split testing"):
        make("training")


def test_movies_are_equal_up_to_the_change(tmp_path: Path) -> None:
    start = found("teleport")[0].start
    parts = four("teleport", base_with("teleport", hidden=False))
    shown = []
    for then in (0, 1):
        scene, path = parts[0, then]
        file = tmp_path / f"{then}.mp4"
        file.write_bytes(make_movies(Renderer(scene, path, 64, 64), 30)[0])
        shown.append(np.stack(list(read_chosen(file, range(len(path))))))
    assert np.array_equal(shown[0][:start], shown[1][:start])
    assert not np.array_equal(shown[0][start:], shown[1][start:])


@pytest.mark.nightly
@pytest.mark.slow
def test_pairs_are_trials_without_labels(tmp_path: Path) -> None:
    settings = GenerateSettings(width=64, height=64, jitters=0)

    def make() -> physion.trials.making.generate.GeneratedDataset:
        return physion.generate(
            tmp_path,
            "dominoes",
            2,
            pairs=["teleport", "swap"],
            settings=settings,
            executor=SerialExecutor(),
        )

    made = make()
    pairs = [name for name in made.trials() if is_pair(name)]
    assert pairs and len(pairs) % 4 == 0
    assert made.index.set_index("trial").loc[pairs, "contact"].isna().all()
    result = verify_dataset(tmp_path, again=100)
    assert not result.faults and not result.notes
    again = make()
    assert not again.report.made and set(again.report.kept) == set(made.trials())
    done = physion.evaluate("chance", tmp_path, tmp_path / "out", folds=2)
    assert not set(done.predictions["stimulus"]) & set(pairs)
    for name in pairs:
        trial = Dataset(tmp_path).trial(name)
        assert np.array_equal(
            trial.trajectory.positions, motion_of(trial.scene, make_engine()).positions
        )


@pytest.mark.slow
def test_a_dataset_of_cloth_says_that_it_allows_none(tmp_path: Path) -> None:
    settings = GenerateSettings(width=32, height=32, jitters=0, movies=False)
    with pytest.raises(BadInputError, match="cloth has none"):
        physion.generate(
            tmp_path, "drape", 1, pairs=["vanish"], settings=settings, executor=SerialExecutor()
        )
