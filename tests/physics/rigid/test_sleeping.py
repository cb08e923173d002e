"""Wake counters and islands."""

from __future__ import annotations

import numpy as np
import pytest

from physion.physics.rigid.sleeping import (
    SleepOptions,
    SleepState,
    find_islands,
    update_sleep,
    wake_touched,
)
from physion.physics.rigid.solver_records import Bodies

OPTIONS = SleepOptions(threshold=0.01, wake_time=0.4, dt=0.01)
NONE = np.zeros((0, 2), np.int64)


def awake_state(actors: int, counter: float = 0.4) -> SleepState:
    return SleepState(
        np.full(actors, counter),
        np.zeros((actors, 3)),
        np.zeros((actors, 3)),
        np.zeros(actors, np.bool_),
    )


def moving(*velocities: list[float]) -> Bodies:
    """Bodies of 2 kg and 0.5 kg m² with these velocities, and the world."""
    count = len(velocities) + 1
    v = np.zeros((count, 3))
    v[:-1] = velocities
    inv_mass, inv_inertia = np.full(count, 0.5), np.tile(2.0 * np.eye(3), (count, 1, 1))
    q = np.tile([1.0, 0, 0, 0], (count, 1))
    return Bodies(np.zeros((count, 3)), q, v, np.zeros((count, 3)), inv_mass, inv_inertia)


def steps(count: int, bodies: Bodies, state: SleepState, pairs: np.ndarray = NONE) -> None:
    for _ in range(count):
        island = find_islands(pairs, len(state.counter))
        update_sleep(pairs, island, bodies, state, OPTIONS)


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


def test_islands_sleep_and_wake_together() -> None:
    chain = np.array([[2, 1], [0, 4], [3, 2], [4, 1]], np.int64)
    # Actor 4 is the world and joins nothing.
    island = find_islands(chain, 4)
    assert island.tolist() == [0, 1, 1, 1]
    state = awake_state(4, counter=0.0)
    state.counter[3] = 0.3
    update_sleep(chain, island, moving(*[[0.0, 0, 0]] * 4), state, OPTIONS)
    assert state.asleep.tolist() == [True, False, False, False]
    state.asleep[1:3] = True
    wake_touched(island, state, 0.4)
    assert state.asleep.tolist() == [True, False, False, False]
    assert state.counter[1:3].tolist() == [0.4, 0.4]
