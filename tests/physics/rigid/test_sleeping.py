"""Wake counters and islands."""

from __future__ import annotations

import numpy as np
import pytest

from physion.physics.rigid.bodies import RigidSettings
from physion.physics.rigid.sleeping import (
    SleepOptions,
    SleepState,
    all_awake,
    find_islands,
    update_sleep,
    wake_touched,
)
from physion.physics.rigid.solver import Bodies
from physion.physics.rigid.step import RigidRun
from physion.scenes.scene import Body, Push
from support.rigid_scenes import ICE, run, scene_of

OPTIONS = SleepOptions(threshold=0.01, wake_time=0.4, dt=0.01)
NONE = np.zeros((0, 2), np.int64)


def awake_state(actors: int, counter: float = 0.4) -> SleepState:
    return all_awake(actors, counter)


def moving(*velocities: list[float]) -> Bodies:
    """Bodies of 2 kg and 0.5 kg m² with these velocities, and the world."""
    count = len(velocities) + 1
    v = np.zeros((count, 3))
    v[:-1] = velocities
    inv_mass, inv_inertia = np.full(count, 0.5), np.tile(2.0 * np.eye(3), (count, 1, 1))
    return Bodies(
        x=np.zeros((count, 3)),
        q=np.tile([1.0, 0, 0, 0], (count, 1)),
        rot=np.tile(np.eye(3), (count, 1, 1)),
        v=v,
        w=np.zeros((count, 3)),
        inertia=np.tile(0.5 * np.eye(3), (count, 1, 1)),
        inv_mass=inv_mass,
        inv_inertia=inv_inertia,
        free_mass=inv_mass,
        free_inertia=inv_inertia,
    )


def steps(count: int, bodies: Bodies, state: SleepState, pairs: np.ndarray = NONE) -> None:
    for _ in range(count):
        find_islands(pairs, len(pairs), state.island)
        move_v, move_w = bodies.v.copy(), bodies.w.copy()
        update_sleep(pairs, len(pairs), bodies, move_v, move_w, state, OPTIONS)


def test_a_body_at_rest_sleeps_when_its_counter_is_down() -> None:
    state = awake_state(1)
    steps(39, moving([0, 0, 0]), state)
    assert state.counter[0] == pytest.approx(0.01)
    assert not state.asleep[0]
    steps(2, moving([0, 0, 0]), state)
    assert state.asleep[0]


def test_a_drift_adds_up_to_the_threshold_and_resets_the_counter() -> None:
    state = awake_state(1, counter=0.15)
    body = moving([0.01, 0, 0])
    steps(14, body, state)
    assert state.counter[0] == pytest.approx(0.01)
    steps(1, body, state)
    # (15 * 0.01)² / 2 = 0.01125 is the first sum above 0.01; the counter is that ratio of 0.2 s.
    assert state.counter[0] == pytest.approx(0.2 * 1.125)
    assert not state.sum_v.any()


def test_a_shake_to_and_fro_cancels() -> None:
    state = awake_state(1, counter=0.15)
    for k in range(20):
        steps(1, moving([0.1 * (-1) ** k, 0, 0]), state)
    assert state.asleep[0]


def test_spin_counts_by_its_energy_over_mass() -> None:
    state = awake_state(1, counter=0.15)
    body = moving([0, 0, 0])
    body.w[0] = [0, 0, 0.3]
    steps(1, body, state)
    # 0.5 * 0.5 kg m² * 0.3² / 2 kg = 0.01125.
    assert state.counter[0] == pytest.approx(0.2 * 1.125)


def test_fast_motion_resets_the_counter_to_the_wake_time() -> None:
    state = awake_state(1, counter=0.15)
    steps(1, moving([5.0, 0, 0]), state)
    assert state.counter[0] == pytest.approx(0.4)


def test_neighbours_raise_the_threshold() -> None:
    on_world = np.array([[0, 1]], np.int64)
    state = awake_state(1, counter=0.15)
    steps(1, moving([0.15, 0, 0]), state, on_world)
    # 0.01125 is below 2 * 0.01.
    assert state.counter[0] == pytest.approx(0.14)


def test_a_turning_body_sums_its_spin_in_its_own_axes() -> None:
    """Summed in world axes, a spin about an axis that turns with the body would cancel."""
    state = awake_state(1, counter=0.15)
    body = moving([0, 0, 0])
    for sign in (1.0, -1.0):
        body.rot[0] = np.diag([1.0, sign, sign])
        body.w[0] = [0, 0, 0.1 * sign]
        steps(1, body, state)
    assert state.sum_w[0].tolist() == pytest.approx([0, 0, 0.2])


def islands(pairs: np.ndarray, actors: int) -> list[int]:
    island = np.zeros(actors, np.int64)
    find_islands(pairs, len(pairs), island)
    return island.tolist()


def test_islands_sleep_and_wake_together() -> None:
    chain = np.array([[2, 1], [0, 4], [3, 2], [4, 1]], np.int64)
    # Actor 4 is the world and joins nothing.
    assert islands(chain, 4) == [0, 1, 1, 1]
    state = awake_state(4, counter=0.0)
    state.counter[3] = 0.3
    steps(1, moving(*[[0.0, 0, 0]] * 4), state, chain)
    assert state.asleep.tolist() == [True, False, False, False]
    state.asleep[1:3] = True
    assert wake_touched(state, 0.4)
    assert state.asleep.tolist() == [True, False, False, False]
    assert state.counter[1:3].tolist() == [0.4, 0.4]
    assert not wake_touched(state, 0.4)


def test_what_falls_asleep_stops() -> None:
    state = awake_state(1, counter=0.0)
    body = moving([0.001, 0, 0])
    body.w[0] = 0.001
    steps(1, body, state)
    assert state.asleep[0]
    assert not body.v[0].any()
    assert not body.w[0].any()


def test_a_resting_box_sleeps_after_the_wake_time_and_stays_to_the_byte() -> None:
    box = Body("a", "cube", (0, 0, 0), (0.4, 0.4, 0.4))
    simulation = RigidRun(scene_of(box), RigidSettings())
    asleep = []
    for frames in range(1, 61):
        simulation.run(frames, frames)
        asleep.append(bool(simulation.sleep.asleep[0]))
        simulation.history.counters[2] = 0
    # 0.4 s are 40 steps; rounding of 40 times 0.01 may cost one more.
    assert asleep.index(True) in (39, 40)
    assert all(asleep[41:])
    path = run(scene_of(box), frames=60)
    assert np.array_equal(path.positions[41:], path.positions[40:-1])


def test_a_push_wakes_what_sleeps_and_what_it_meets() -> None:
    boxes = [Body(n, "cube", (x, 0, 0), (0.4,) * 3, contact=ICE) for n, x in (("a", 0), ("b", 1.0))]
    scene = scene_of(*boxes, pushes=(Push("a", (2.0, 0, 0), None, 60),))
    path = run(scene, frames=110, floor=ICE)
    assert not path.velocities[59].any()
    assert path.velocities[60, 0, 0] == pytest.approx(2.0)
    # 0.6 m at 2 m/s are 30 steps. Without restitution both go on with half the speed.
    assert not path.velocities[85, 1].any()
    assert path.velocities[109, :2, 0].tolist() == pytest.approx([1.0, 1.0], rel=1e-3)
