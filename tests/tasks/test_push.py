"""The environment of one push: accepted by Gymnasium's check, repeatable, and solvable."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from physion.core.errors import BadInputError
from physion.physics.engine import simulate
from physion.tasks.push import MAX_SPEED, SCENARIOS, PushEnv

NAME = "physion.tasks.push:physion/Push-v0"


@pytest.mark.slow
@pytest.mark.filterwarnings("error::UserWarning")
@pytest.mark.parametrize("observation", ["states", "pixels"])
def test_gymnasium_accepts_it(observation: str) -> None:
    env = gymnasium.make(NAME, observation=observation, size=64, render_mode="rgb_array")
    check_env(env.unwrapped)
    assert env.unwrapped.render().shape == (64, 64, 3)


@pytest.mark.slow
@pytest.mark.parametrize("scenario", SCENARIOS)
def test_some_pushes_make_red_touch_yellow_and_others_do_not(scenario: str) -> None:
    env = PushEnv(scenario)
    rewards = []
    for speed in (0.0, 0.1, 0.25, 0.5, 0.75, 0.9):
        env.reset(seed=0)
        rewards.append(env.step(np.array([speed, 0.0], np.float32))[1])
    assert rewards[0] == 0.0 and set(rewards) == {0.0, 1.0}


def test_the_probe_gets_the_speed_of_the_action() -> None:
    env = PushEnv("dominoes")
    start, about = env.reset(seed=3)
    again, _ = env.reset(seed=3)
    assert np.array_equal(start, again) and about["scene"]
    assert start.shape == env.observation_space.shape
    first = env.step(np.array([0.2, 0.1], np.float32))
    assert env._shown is not None
    scene, path = env._shown
    probe = scene.index(str(scene.roles.probe))
    # In frame 0, after the first step, friction has taken little.
    assert path.velocities[0, probe, :2] == pytest.approx([2.0, 1.0], abs=0.15)
    assert MAX_SPEED == 10.0 and len(simulate(scene)) == len(path)
    env.reset(seed=3)
    second = env.step(np.array([0.2, 0.1], np.float32))
    assert np.array_equal(first[0], second[0]) and first[1:] == second[1:]
    assert first[2] and not first[3]
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros(2, np.float32))


def test_what_cannot_be_pushed_is_refused() -> None:
    with pytest.raises(BadInputError, match="nothing is pushed in scenario 'drop'"):
        PushEnv("drop")
    with pytest.raises(BadInputError, match="states or pixels"):
        PushEnv(observation="words")  # type: ignore[arg-type]
