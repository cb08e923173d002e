"""Equal bytes over processes, threads, orders of scenes, and sizes of work space."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from physion.physics.rigid import step as run_module
from physion.physics.rigid.bodies import RigidSettings
from physion.physics.rigid.engine import RigidEngine
from physion.physics.rigid.step import RigidRun
from physion.physics.trajectory import Trajectory
from physion.scenes.scene import Body, Push, Roles, Scene
from support.rigid_scenes import ROUGH, scene_of

FRAMES = 90


def heap(seed: int, count: int = 6) -> Scene:
    """Bodies of many shapes that fall onto each other; the first is pushed."""
    rng = np.random.default_rng(seed)
    shapes = ["torus", "cube", "cone", "bowl", "cylinder", "sphere"]
    bodies = [
        Body(
            f"body {k}",
            shapes[k % len(shapes)],
            (*rng.uniform(-0.1, 0.1, 2).tolist(), 0.1 + 0.35 * k),
            (0.3, 0.3, 0.3),
            tuple((q / np.linalg.norm(q)).tolist()),  # type: ignore[arg-type]
            contact=ROUGH,
        )
        for k, q in enumerate(rng.normal(size=(count, 4)))
    ]
    return scene_of(*bodies, pushes=(Push("body 0", (0.5, 0.2, 0), None, 5),))


def digests(paths: Sequence[Trajectory]) -> list[str]:
    return [path.digest() for path in paths]


@pytest.mark.slow
def test_same_bytes_with_any_number_of_threads_and_in_any_order() -> None:
    scenes = [heap(seed) for seed in range(6)]
    alone = digests([RigidEngine().simulate(scene, frames=FRAMES) for scene in scenes])
    assert len(set(alone)) == len(scenes)
    for threads in (1, 2, 4):
        engine = RigidEngine(threads=threads)
        assert digests(engine.simulate_many(scenes, frames=FRAMES)) == alone
        assert digests(engine.simulate_many(scenes[::-1], frames=FRAMES)) == alone[::-1]
    # The same scene in several threads at once shares the hulls of its shapes.
    same = RigidEngine(threads=4).simulate_many([scenes[0]] * 8, frames=FRAMES)
    assert digests(same) == [alone[0]] * 8


def test_many_scenes_stop_at_contact_each_for_itself() -> None:
    roles = Roles("body 0", "body 2")
    scenes = [replace(heap(seed), roles=roles) for seed in range(4)]
    together = RigidEngine(threads=2).simulate_many(scenes, frames=FRAMES, until_contact=True)
    assert len({len(path) for path in together}) > 1
    apart = [RigidEngine().simulate(s, frames=FRAMES, until_contact=True) for s in scenes]
    assert digests(together) == digests(apart)


def test_no_scenes_give_no_trajectories() -> None:
    assert RigidEngine().simulate_many([]) == []


@pytest.mark.parametrize("small", [(1, 2048, 128), (512, 8, 128), (512, 2048, 1), (64, 512, 64)])
def test_work_space_that_grows_changes_no_byte(
    monkeypatch: pytest.MonkeyPatch, small: tuple[int, int, int]
) -> None:
    scene = heap(5, count=9)

    def simulate(room: tuple[int, int, int]) -> RigidRun:
        for name, value in zip(("PAIRS", "ROWS", "FRAMES"), room, strict=True):
            monkeypatch.setattr(run_module, name, value)
        simulation = RigidRun(scene, RigidSettings())
        simulation.run(FRAMES, FRAMES)
        return simulation

    large = simulate((4096, 65536, 1024))
    pairs, rows = int(large.space.counters[0]), int(large.history.counters[1])
    assert (pairs > 64, rows > 512) == (True, True)
    grown = simulate(small)
    # It did start too small, and has grown where it had to.
    room = len(grown.manifolds.size), len(grown.history.frame), len(grown.history.state)
    assert room != small
    assert all(have >= needed for have, needed in zip(room, (pairs, rows, FRAMES), strict=True))
    assert grown.trajectory("test").digest() == large.trajectory("test").digest()


def test_a_run_in_parts_is_the_run_as_a_whole() -> None:
    scene = heap(6)
    whole, parts = RigidRun(scene, RigidSettings()), RigidRun(scene, RigidSettings())
    whole.run(FRAMES, FRAMES)
    for stop in (1, 7, 50, FRAMES):
        parts.run(stop, stop)
        parts.history.counters[2] = 0
    assert parts.trajectory("test").digest() == whole.trajectory("test").digest()
